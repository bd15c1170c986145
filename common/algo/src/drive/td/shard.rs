//! A part of the batch: forward through both networks, and backward.

use super::{Pass, Role, Said, TdPass, Utilities, ValueNetwork};
use crate::{
    Rows,
    blocks::{MixerWeights, TaskEncoder, decoder::Tables},
    drive::shards::{Sums, Worker, Workers, tree_sum_f64},
    estimators::td,
};
use rayon::prelude::*;
use rit_nn::{Buffer, Scratch, Stock, Tape, Var, View};
use std::mem;

/// One set of weights, with what the decoder makes of them.
#[derive(Clone, Copy)]
pub(super) struct Weights<'a> {
    pub(super) params: &'a [f32],
    pub(super) tables: &'a Tables,
}

/// What a whole batch's means divide by.
#[derive(Clone, Copy, Debug)]
pub struct Totals {
    /// Decision steps.
    pub filled: usize,
    /// Decision steps of every agent.
    pub filled_agents: usize,
}

/// A shard's state that is kept between the parts of an update.
#[derive(Default)]
pub(super) struct Shard {
    pub(super) grads: Vec<f32>,
    pub(super) sums: ShardSums,
    /// Memory of its task representations' tape.
    pub(super) stock: Scratch,
    /// Memory of its online tape, where that must last.
    online: Stock,
}

/// A shard's share of the batch's sums, or the batch's.
#[derive(Clone, Debug, Default)]
pub(super) struct ShardSums {
    /// Squared TD errors; the contrastive loss; Q_total; targets; saturated units of the agents' memory.
    pub(super) common: [f64; 5],
    /// The method's own.
    pub(super) own: Sums,
}

impl Shard {
    pub(super) fn clear(&mut self, params: usize) {
        self.grads.clear();
        self.grads.resize(params, 0.0);
        self.sums = ShardSums::default();
    }
}

/// Task representations of a shard, on a tape of their own.
pub(super) struct Represented<'a> {
    pub(super) tape: Tape<'a>,
    pub(super) representation: Var,
    /// Loss's gradient by them, `[R, h_z]`.
    pub(super) d: Vec<f32>,
}

impl<'a> Represented<'a> {
    /// Makes them; values lie in `stock`, temporaries in the worker's memory.
    pub(super) fn new(
        task_encoder: &TaskEncoder,
        params: &'a [f32],
        rows: &'a Rows,
        stock: Scratch,
        worker: &mut Worker,
    ) -> Self {
        let work = mem::take(&mut worker.online.work);
        let mut tape = Tape::recording(params, Stock { values: stock, work });
        let (_, representation) = task_encoder.forward(&mut tape, rows, None);
        worker.online.work = tape.work_in(Scratch::default());
        let d = vec![0.0; representation.len()];
        Self { tape, representation, d }
    }

    /// From the whole gradient by them to that by the task encoder's parameters.
    fn backward(&mut self, d: Option<Buffer>, grads: &mut [f32], worker: &mut Worker) {
        self.tape.work_in(mem::take(&mut worker.online.work));
        for d in [View::dense(&self.d, self.representation.cols)]
            .into_iter()
            .chain(d.as_deref().map(|d| View::dense(d, self.representation.cols)))
        {
            self.tape.seed(self.representation, d);
        }
        self.tape.backward(grads);
        worker.online.work = self.tape.work_in(Scratch::default());
        if let Some(d) = d {
            worker.online.work.give(d);
        }
    }

    pub(super) fn into_stock(self) -> Scratch {
        self.tape.into_stock().values
    }
}

/// What a shard's passes read beside its rows.
pub(super) struct ShardInputs<I> {
    /// The batch's index of the rows' episode 0.
    pub(super) first_episode: usize,
    /// The method's own.
    pub(super) own: I,
}

/// What all shards of an update share.
pub(super) struct Update<'a, N: ValueNetwork> {
    pub(super) network: &'a N,
    pub(super) online: Weights<'a>,
    pub(super) target: Weights<'a>,
    pub(super) gamma: f32,
    pub(super) reward_scale: f32,
    pub(super) totals: Totals,
}

/// A shard's online pass, ready to go backward.
struct Online<'a, E> {
    tape: Tape<'a>,
    /// z, the tape's input.
    representation: Option<Var>,
    extras: E,
}

/// What both networks prepare without knowing actions.
struct Prepared<'a, E> {
    utilities: Utilities<'a, E>,
    mixing: Option<MixerWeights>,
}

impl<N: ValueNetwork> Update<'_, N> {
    /// All shards, each forward and backward in one go.
    pub(super) fn run(
        &self,
        rows: &[Rows],
        inputs: &[ShardInputs<N::Inputs>],
        shards: &mut [Shard],
        represented: &mut [Option<Represented<'_>>],
        workers: &Workers,
        see: &(impl Fn(&SeenShard<'_>) + Sync),
    ) -> ShardSums {
        rows.par_iter().zip(inputs).zip(&mut *shards).zip(represented).for_each(
            |(((rows, inputs), shard), represented)| {
                if rows.groups.is_empty() {
                    return;
                }
                workers.with(|worker| {
                    let Shard { grads, sums, .. } = shard;
                    let of_online = mem::take(&mut worker.online);
                    let (z, target) = (represented.as_ref(), &mut worker.target);
                    let online = self.forward(rows, inputs, z, sums, of_online, target, see);
                    let (d, stock) = online.backward(grads);
                    worker.online = stock;
                    if let Some(represented) = represented {
                        represented.backward(d, grads, worker);
                    }
                });
            },
        );
        total(shards)
    }

    /// All shards forward, then, their sums known, all backward.
    pub(super) fn run_coupled(
        &self,
        rows: &[Rows],
        inputs: &[ShardInputs<N::Inputs>],
        shards: &mut [Shard],
        represented: &mut [Option<Represented<'_>>],
        workers: &Workers,
        see: &(impl Fn(&SeenShard<'_>) + Sync),
    ) -> ShardSums {
        let passes = rows.par_iter().zip(inputs).zip(&mut *shards).zip(&*represented);
        let passes = passes.map(|(((rows, inputs), shard), represented)| {
            (!rows.groups.is_empty()).then(|| {
                let Shard { sums, online, .. } = shard;
                workers.with(|worker| {
                    let (stock, target) = (mem::take(online), &mut worker.target);
                    self.forward(rows, inputs, represented.as_ref(), sums, stock, target, see)
                })
            })
        });
        let passes: Vec<_> = passes.collect();
        let sums = total(shards);
        let gradients = passes.into_par_iter().zip(rows).zip(&mut *shards).map(|((pass, rows), shard)| {
            let mut pass = pass?;
            self.network.seed(&mut pass.tape, rows, self.totals, &pass.extras, &sums.own);
            let (d, stock) = pass.backward(&mut shard.grads);
            shard.online = stock;
            d
        });
        let gradients: Vec<_> = gradients.collect();
        gradients.into_par_iter().zip(shards).zip(represented).for_each(|((d, shard), represented)| {
            if let Some(represented) = represented {
                workers.with(|worker| represented.backward(d, &mut shard.grads, worker));
            }
        });
        sums
    }

    /// Both networks forward, the greedy pass, targets, and the losses with their gradients by what the online network
    /// made.
    #[allow(clippy::too_many_arguments, reason = "a matrix and its companions, each named")]
    fn forward<'p>(
        &'p self,
        rows: &'p Rows,
        inputs: &'p ShardInputs<N::Inputs>,
        represented: Option<&'p Represented<'_>>,
        sums: &mut ShardSums,
        stock: Stock,
        target_stock: &mut Stock,
        see: &impl Fn(&SeenShard<'_>),
    ) -> Online<'p, N::Extras> {
        let parts = self.network.parts();
        // The target network goes first, as far as it can: what backward needs of the online one is fresher then.
        let mut target = Tape::inference(self.target.params, mem::take(target_stock));
        let of_target = parts.task.as_ref().map(|(task_encoder, _)| {
            let (history, representation) = task_encoder.forward(&mut target, rows, None);
            target.free(history);
            representation
        });
        let prepared = self.prepare(&mut target, self.target, Role::Target, rows, inputs, of_target);

        let mut tape = Tape::recording(self.online.params, stock);
        let representation =
            represented.map(|represented| tape.input(represented.tape.view(represented.representation)));
        let Prepared { utilities: Utilities { memory, mut head, extras }, mixing } =
            self.prepare(&mut tape, self.online, Role::Online, rows, inputs, representation);
        let greedy = head.greedy(&tape, rows, parts.n_actions);
        // The greedy pass's utilities make room for those of the actions taken, which backward needs.
        let utilities = head.utilities(&mut tape, rows, &rows.actions);
        let q_total = self.q_total(&mut tape, rows, utilities, mixing.as_ref(), &rows.actions);
        let of_target = prepared.utilities.head.utilities(&mut target, rows, &greedy);
        let target_q_total = self.q_total(&mut target, rows, of_target, prepared.mixing.as_ref(), &greedy);

        let values = [tape.slice(q_total), target.slice(target_q_total)];
        let Targets { td_targets, d_total } = self.targets(rows, values, &mut sums.common);
        tape.seed(q_total, View::dense(&d_total, 1));
        if parts.gru {
            sums.common[4] = saturated(tape.view(memory), rows) as f64;
        }
        let pass = TdPass {
            rows,
            inputs: &inputs.own,
            totals: self.totals,
            td_targets: &td_targets,
            mixing,
            memory,
            utilities,
            extras: &extras,
        };
        let mut said = vec![("history", memory), ("utilities", utilities), ("q_total", q_total)];
        said.extend(representation.map(|representation| ("task_representation", representation)));
        sums.own = self.network.sums(&mut tape, &pass, &mut said);
        see(&SeenShard {
            rows,
            first_episode: inputs.first_episode,
            tape: &tape,
            said,
            greedy_actions: &greedy,
            target_q_total: target.slice(target_q_total),
            td_targets: &td_targets,
        });
        *target_stock = target.into_stock();
        Online { tape, representation, extras }
    }

    /// All of a network that needs no actions.
    fn prepare<'p>(
        &'p self,
        tape: &mut Tape<'p>,
        weights: Weights<'p>,
        role: Role,
        rows: &'p Rows,
        inputs: &'p ShardInputs<N::Inputs>,
        representation: Option<Var>,
    ) -> Prepared<'p, N::Extras> {
        let (tables, inputs) = (weights.tables, &inputs.own);
        let pass = Pass { role, rows, tables, representation, before: None, inputs };
        let utilities = self.network.forward(tape, pass);
        let mixer = self.network.parts().mixer.as_ref();
        Prepared { utilities, mixing: mixer.map(|mixer| mixer.weights(tape, rows, representation)) }
    }

    /// Q_total (G, 1) of these actions.
    fn q_total<'p>(
        &self,
        tape: &mut Tape<'p>,
        rows: &'p Rows,
        utilities: Var,
        mixing: Option<&MixerWeights>,
        actions: &[u8],
    ) -> Var {
        let chosen = tape.choose(utilities, actions);
        match (&self.network.parts().mixer, mixing) {
            (Some(mixer), Some(weights)) => mixer.mix(tape, &rows.groups, weights, chosen),
            _ => tape.sum_over_members(chosen, &rows.groups),
        }
    }

    /// TD targets, and the TD loss's gradient by Q_total, from the online and the target network's Q_total of each
    /// group; adds to the sums.
    fn targets(&self, rows: &Rows, [q_total, target_q_total]: [&[f32]; 2], sums: &mut [f64; 5]) -> Targets {
        let mut td_targets = vec![0.0; rows.steps.len()];
        let mut d_total = vec![0.0; rows.steps.len()];
        for (group, step) in rows.steps.iter().enumerate().filter(|(_, step)| step.filled) {
            let next = rows.next_group(group).map_or(0.0, |next| target_q_total[next]);
            let target = td::target(step.reward * self.reward_scale, self.gamma, step.terminated, next);
            let (loss, d) = td::squared_error(target, q_total[group], self.totals.filled);
            let [losses, _, q_totals, targets, _] = sums;
            *losses += loss;
            *q_totals += f64::from(q_total[group]);
            *targets += f64::from(target);
            (td_targets[group], d_total[group]) = (target, self.network.td_weight() * d);
        }
        Targets { td_targets, d_total }
    }
}

/// Units of agents' memory (R, memory) near their bounds, at the steps where something was decided.
fn saturated(memory: View<'_>, rows: &Rows) -> usize {
    const NEAR: f32 = 0.99;
    let decided = rows.groups.iter().zip(&rows.steps).filter(|(_, step)| step.filled);
    let of_row = |row| memory.row(row).iter().filter(|unit| unit.abs() > NEAR).count();
    decided.flat_map(|(group, _)| group.queries.clone()).map(of_row).sum()
}

/// Of each group; 0 where nothing was decided.
struct Targets {
    td_targets: Vec<f32>,
    /// Loss's gradient by Q_total.
    d_total: Vec<f32>,
}

impl<E> Online<'_, E> {
    /// Adds to the parameters' gradients; returns the gradient by z, and the tape's memory.
    fn backward(mut self, grads: &mut [f32]) -> (Option<Buffer>, Stock) {
        self.tape.backward(grads);
        let d = self.representation.map(|representation| self.tape.take_gradient(representation));
        (d, self.tape.into_stock())
    }
}

/// The sums over all shards, in their tree.
fn total(shards: &[Shard]) -> ShardSums {
    let common: Vec<Sums> = shards.iter().map(|shard| shard.sums.common.to_vec()).collect();
    // Shards without rows have zeros to add.
    let len = shards.iter().map(|shard| shard.sums.own.len()).max().unwrap_or(0);
    let own: Vec<Sums> = shards
        .iter()
        .map(|shard| {
            let mut own = shard.sums.own.clone();
            own.resize(len, 0.0);
            own
        })
        .collect();
    let mut sums = ShardSums { own: tree_sum_f64(&own), ..ShardSums::default() };
    sums.common.copy_from_slice(&tree_sum_f64(&common));
    sums
}

/// What the networks said of a shard: for comparison with other implementations.
pub struct SeenShard<'s> {
    /// The shard's rows.
    pub rows: &'s Rows,
    /// The batch's index of their episode 0.
    pub first_episode: usize,
    tape: &'s Tape<'s>,
    said: Said,
    /// The online network's greedy joint action of each agent row.
    pub greedy_actions: &'s [u8],
    /// The target network's Q_total of these, of each group.
    pub target_q_total: &'s [f32],
    /// The TD target of each group; 0 where nothing was decided.
    pub td_targets: &'s [f32],
}

impl SeenShard<'_> {
    /// What the online network made, by name: a row for each agent row, or for each group.
    pub fn values(&self) -> impl Iterator<Item = (&'static str, View<'_>)> {
        self.said.iter().map(|&(name, var)| (name, self.tape.view(var)))
    }
}
