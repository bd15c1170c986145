//! The networks choosing joint actions, one row after another, for several running episodes at once.

use crate::{
    Rit, Rows,
    decoder::{Decoder, DecoderState, Seen, Tables, best},
    methods::Actor,
    task_encoder::TaskEncoderState,
    utility::UtilityState,
};
use rit_episode::{Policy, Turn};
use rit_nn::{Scratch, View, vectorized};
use std::sync::Arc;

/// A policy of the networks, ε-greedy. Holds only what acting needs: utility network and task encoder.
pub struct RitActing {
    rit: Arc<Rit>,
    params: Vec<f32>,
    tables: Tables,
    /// The recurrent states of each slot's running episode.
    memories: Vec<Memory>,
    rows: Rows,
    task_encoder: TaskEncoderState,
    utility: UtilityState,
    scratch: Scratch,
    before: Memory,
}

/// Recurrent states after the last step, agents in decision order.
#[derive(Clone, Debug, Default)]
struct Memory {
    /// τ, `[n, h]`.
    utility: Vec<f32>,
    /// The task encoder's, `[n, h]`.
    task_encoder: Vec<f32>,
}

impl RitActing {
    /// Acts with the given acting parameters (see [`Rit::acting`]).
    pub fn new(rit: Arc<Rit>, params: &[f32]) -> Self {
        let mut acting = Self {
            rit,
            params: Vec::new(),
            tables: Tables::default(),
            memories: Vec::new(),
            rows: Rows::default(),
            task_encoder: TaskEncoderState::default(),
            utility: UtilityState::default(),
            scratch: Scratch::default(),
            before: Memory::default(),
        };
        acting.set_params(params);
        acting
    }

    /// The utilities of the last [`Policy::act`], turn after turn, `[agent rows, A]`: each row's Q given the
    /// actions that were chosen before it.
    pub fn utilities(&self) -> &[f32] {
        &self.utility.decoder.utilities
    }

    /// The task representations of the last [`Policy::act`], turn after turn, `[agent rows, h_z]`.
    pub fn task_representations(&self) -> &[f32] {
        &self.task_encoder.representation
    }
}

impl Actor for RitActing {
    fn set_params(&mut self, params: &[f32]) {
        assert_eq!(params.len(), self.rit.acting().len(), "the parameters that acting needs");
        self.params.clear();
        self.params.extend_from_slice(params);
        self.tables = self.rit.utility.decoder.tables(&self.params);
    }
}

impl Policy for RitActing {
    fn begin(&mut self, slot: usize, n_agents: usize) {
        if self.memories.len() <= slot {
            self.memories.resize_with(slot + 1, Memory::default);
        }
        let len = n_agents * self.rit.config.hidden_dim;
        let Memory { utility, task_encoder } = &mut self.memories[slot];
        for state in [utility, task_encoder] {
            state.clear();
            state.resize(len, 0.0);
        }
    }

    fn act(&mut self, turns: &mut [Turn<'_>]) {
        let h = self.rit.config.hidden_dim;
        let Self { rit, params, tables, memories, rows, task_encoder, utility, scratch, before } = self;
        rows.fill_from_turns(turns);
        before.utility.clear();
        before.task_encoder.clear();
        for turn in turns.iter() {
            before.utility.extend_from_slice(&memories[turn.slot].utility);
            before.task_encoder.extend_from_slice(&memories[turn.slot].task_encoder);
        }
        let of_task_encoder = Some(View::dense(&before.task_encoder, h));
        rit.represent(params, rows, of_task_encoder, task_encoder, scratch);
        let z = rit.representation(&task_encoder.representation);
        let before = Some(View::dense(&before.utility, h));
        rit.utility.forward(params, tables, rows, before, z, utility, scratch);
        for (group, turn) in rows.groups.iter().zip(turns.iter()) {
            let states = group.queries.start * h..group.queries.end * h;
            let memory = &mut memories[turn.slot];
            memory.utility.copy_from_slice(&utility.history()[states.clone()]);
            if rit.task_encoder.is_some() {
                memory.task_encoder.copy_from_slice(&task_encoder.history()[states]);
            }
        }

        choose(&rit.utility.decoder, params, tables, rows, &mut utility.decoder, turns);
    }
}

vectorized! {
    /// Every turn's joint action, row after row, each given the actions before it.
    fn choose<'a, 'b>(
        decoder: &'a Decoder,
        params: &'a [f32],
        tables: &'a Tables,
        rows: &'a Rows,
        state: &'a mut DecoderState,
        turns: &'a mut [Turn<'b>],
    ) {
        let n_actions = decoder.n_actions();
        let mut seen = Seen::start(n_actions);
        for (group, turn) in rows.groups.iter().zip(turns) {
            seen.restart();
            for (row, action) in group.queries.clone().zip(turn.actions.iter_mut()) {
                let available = &rows.available[row * n_actions..][..n_actions];
                let utilities = decoder.decide(params, tables, row, &seen, state);
                let random = turn.exploration.explore(row - group.queries.start, available);
                *action = random.unwrap_or_else(|| best(utilities, available));
                seen.push(*action);
            }
        }
    }
}
