//! Networks with utilities choosing joint actions for several running episodes at once, ε-greedy.

use super::td::{Head, Pass, Role, Utilities, ValueNetwork};
use crate::{
    Rows,
    blocks::{
        Decoder, DecoderPass,
        decoder::{Seen, Tables},
    },
    estimators::greedy::greedy_action,
    networks::Actor,
};
use rit_episode::{Policy, Turn};
use rit_nn::{Stock, Tape, View, vectorized};
use std::{mem, sync::Arc};

/// A policy of a method's networks. Holds only what acting needs.
pub struct ValueActing<N: ValueNetwork> {
    network: Arc<N>,
    /// With what is derived from them.
    params: Vec<f32>,
    tables: Tables,
    /// What the agents of each slot's running episode remember.
    memories: Vec<Memory>,
    before: Memory,
    rows: Rows,
    stock: Stock,
    /// Of the last step, `[agent rows, A]`.
    utilities: Vec<f32>,
    /// Of the last step, `[agent rows, h_z]`; empty without.
    representations: Vec<f32>,
}

/// After the last step, agents in decision order.
#[derive(Clone, Debug, Default)]
struct Memory {
    /// Of the utility network, `[n, memory]`.
    utility: Vec<f32>,
    /// Of the task encoder, `[n, h]`; empty without one.
    task_encoder: Vec<f32>,
}

impl<N: ValueNetwork> ValueActing<N> {
    /// Acts with the given acting parameters ([`ValueParts::acting`](super::ValueParts::acting)).
    pub fn new(network: Arc<N>, params: &[f32]) -> Self {
        let mut acting = Self {
            network,
            params: Vec::new(),
            tables: Tables::default(),
            memories: Vec::new(),
            before: Memory::default(),
            rows: Rows::default(),
            stock: Stock::default(),
            utilities: Vec::new(),
            representations: Vec::new(),
        };
        acting.set_params(params);
        acting
    }

    /// The utilities of the last [`Policy::act`], turn after turn, `[agent rows, A]`: each row's Q given the actions
    /// that were chosen before it.
    pub fn utilities(&self) -> &[f32] {
        &self.utilities
    }

    /// Numbers that an agent's task encoder remembers.
    fn task_memory_dim(&self) -> usize {
        self.network.parts().task.as_ref().map_or(0, |(task_encoder, _)| task_encoder.memory_dim())
    }
}

impl<N: ValueNetwork> Actor for ValueActing<N> {
    fn utilities(&self) -> &[f32] {
        &self.utilities
    }

    fn task_representations(&self) -> &[f32] {
        &self.representations
    }

    fn set_params(&mut self, params: &[f32]) {
        assert_eq!(params.len(), self.network.parts().acting.len(), "the parameters that acting needs");
        self.network.parts().layout.derived().extend(params, &mut self.params);
        self.tables = self.network.tables(&self.params);
    }
}

impl<N: ValueNetwork> Policy for ValueActing<N> {
    fn begin(&mut self, slot: usize, n_agents: usize) {
        if self.memories.len() <= slot {
            self.memories.resize_with(slot + 1, Memory::default);
        }
        let dims = [self.network.parts().memory_dim, self.task_memory_dim()];
        let Memory { utility, task_encoder } = &mut self.memories[slot];
        for (state, dim) in [utility, task_encoder].into_iter().zip(dims) {
            state.clear();
            state.resize(n_agents * dim, 0.0);
        }
    }

    fn act(&mut self, turns: &mut [Turn<'_>]) {
        let dims = [self.network.parts().memory_dim, self.task_memory_dim()];
        let Self { network, params, tables, memories, before, rows, stock, utilities, representations } =
            self;
        let (parts, rows, before) = (network.parts(), &mut *rows, &mut *before);
        rows.fill_from_turns(turns);
        before.utility.clear();
        before.task_encoder.clear();
        for turn in turns.iter() {
            before.utility.extend_from_slice(&memories[turn.slot].utility);
            before.task_encoder.extend_from_slice(&memories[turn.slot].task_encoder);
        }
        let inputs = network.inputs(rows, &network.draw_acting(turns), 0);
        let mut tape = Tape::inference(params, mem::take(stock));
        let mut task_memory = None;
        let representation = parts.task.as_ref().map(|(task_encoder, _)| {
            let before = tape.constant(View::dense(&before.task_encoder, dims[1]));
            let (memory, representation) = task_encoder.forward(&mut tape, rows, Some(before));
            task_memory = Some(memory);
            representation
        });
        let before = Some(tape.constant(View::dense(&before.utility, dims[0])));
        let pass = Pass { role: Role::Acting, rows, tables, representation, before, inputs: &inputs };
        let Utilities { memory, head, .. } = network.forward(&mut tape, pass);
        for (group, turn) in rows.groups.iter().zip(turns.iter()) {
            let states = |dim: usize| group.queries.start * dim..group.queries.end * dim;
            let own = &mut memories[turn.slot];
            own.utility.copy_from_slice(&tape.slice(memory)[states(dims[0])]);
            if let Some(memory) = task_memory {
                own.task_encoder.copy_from_slice(&tape.slice(memory)[states(dims[1])]);
            }
        }
        utilities.clear();
        representations.clear();
        representations.extend_from_slice(representation.map_or(&[], |z| tape.slice(z)));
        match head {
            Head::Independent(of_rows) => {
                choose_at_once(tape.slice(of_rows), rows, parts.n_actions, turns);
                utilities.extend_from_slice(tape.slice(of_rows));
            }
            Head::Ordered(ordered) => {
                let (decoder, mut pass) = *ordered;
                choose_in_order(&decoder, params, rows, &mut pass, turns);
                utilities.extend_from_slice(pass.decided());
                pass.free(&mut tape);
            }
        }
        *stock = tape.into_stock();
    }
}

/// Every turn's joint action, each agent on its own.
fn choose_at_once(utilities: &[f32], rows: &Rows, n_actions: usize, turns: &mut [Turn<'_>]) {
    for (group, turn) in rows.groups.iter().zip(turns) {
        for (agent, (row, action)) in group.queries.clone().zip(turn.actions.iter_mut()).enumerate() {
            let of_row = row * n_actions..(row + 1) * n_actions;
            let available = &rows.available[of_row.clone()];
            let random = turn.exploration.explore(agent, available);
            *action = random.unwrap_or_else(|| greedy_action(&utilities[of_row], available));
        }
    }
}

vectorized! {
    /// Every turn's joint action, row after row, each given the actions before it.
    fn choose_in_order<'a, 'b, 'c>(
        decoder: &'a Decoder,
        params: &'a [f32],
        rows: &'a Rows,
        pass: &'a mut DecoderPass<'b>,
        turns: &'a mut [Turn<'c>],
    ) {
        let n_actions = decoder.n_actions();
        let mut seen = Seen::start(n_actions);
        for (group, turn) in rows.groups.iter().zip(turns) {
            seen.restart();
            for (row, action) in group.queries.clone().zip(turn.actions.iter_mut()) {
                let available = &rows.available[row * n_actions..][..n_actions];
                let utilities = decoder.decide(params, row, &seen, pass);
                let random = turn.exploration.explore(row - group.queries.start, available);
                *action = random.unwrap_or_else(|| greedy_action(utilities, available));
                seen.push(*action);
            }
        }
    }
}
