//! MAPPO choosing joint actions, for several running episodes at once.

use super::Mappo;
use crate::{
    networks::Actor,
    on_policy::{self, ActorCritic as _},
};
use rit_episode::{Policy, Turn};
use rit_nn::{
    View,
    tape::{Stock, Tape},
};
use std::sync::Arc;

/// A policy of the networks: holds only what acting needs.
pub struct MappoActing {
    mappo: Arc<Mappo>,
    params: Vec<f32>,
    /// The recurrent states of each slot's running episode, `[n, h]`.
    memories: Vec<Vec<f32>>,
    inputs: on_policy::Inputs,
    before: Vec<f32>,
    stock: Stock,
    logits: Vec<f32>,
}

impl MappoActing {
    /// Acts with the given acting parameters (see [`on_policy::ActorCritic::acting`]).
    ///
    /// # Panics
    /// When there are not as many as acting needs.
    pub fn new(mappo: Arc<Mappo>, params: &[f32]) -> Self {
        let mut acting = Self {
            mappo,
            params: Vec::new(),
            memories: Vec::new(),
            inputs: on_policy::Inputs::default(),
            before: Vec::new(),
            stock: Stock::default(),
            logits: Vec::new(),
        };
        acting.set_params(params);
        acting
    }

    /// The logits of the last [`Policy::act`], turn after turn, `[agent rows, A]`.
    pub fn logits(&self) -> &[f32] {
        &self.logits
    }
}

impl Actor for MappoActing {
    fn utilities(&self) -> &[f32] {
        &self.logits
    }

    fn set_params(&mut self, params: &[f32]) {
        assert_eq!(params.len(), self.mappo.acting().len(), "the parameters that acting needs");
        self.params.clear();
        self.params.extend_from_slice(params);
    }
}

impl Policy for MappoActing {
    fn begin(&mut self, slot: usize, n_agents: usize) {
        if self.memories.len() <= slot {
            self.memories.resize_with(slot + 1, Vec::new);
        }
        self.memories[slot].clear();
        self.memories[slot].resize(n_agents * self.mappo.config.hidden_dim, 0.0);
    }

    fn act(&mut self, turns: &mut [Turn<'_>]) {
        let Self { mappo, params, memories, inputs, before, stock, logits } = self;
        let (h, slots) = (mappo.config.hidden_dim, mappo.config.slots);
        inputs.rows.fill_from_turns(turns);
        slots.observations(&inputs.rows, &mut inputs.observations);
        before.clear();
        turns.iter().for_each(|turn| before.extend_from_slice(&memories[turn.slot]));

        let mut tape = Tape::inference(params, std::mem::take(stock));
        let observations = tape.constant(View::dense(&inputs.observations, slots.width()));
        let before = tape.constant(View::dense(before, h));
        let (history, of_rows) = mappo.act(&mut tape, &inputs.rows, observations, before);
        logits.clear();
        logits.extend_from_slice(tape.slice(of_rows));
        let n_actions = mappo.config.n_actions;
        for (group, turn) in inputs.rows.groups.iter().zip(turns) {
            let states = group.queries.start * h..group.queries.end * h;
            memories[turn.slot].copy_from_slice(&tape.slice(history)[states]);
            for (row, action) in group.queries.clone().zip(turn.actions.iter_mut()) {
                let of_row = row * n_actions..(row + 1) * n_actions;
                let available = &inputs.rows.available[of_row.clone()];
                *action = on_policy::choose(&logits[of_row], available, turn.exploration);
            }
        }
        *stock = tape.into_stock();
    }
}
