//! A part of the batch: forward through both networks, and backward.

use crate::{Networks, Rit, Rows, TerminalStates, decoder::Tables, task_encoder::TaskEncoderState, td};
use rit_episode::Episode;
use rit_nn::{Scratch, View, ViewMut};
use std::{
    mem,
    ops::Range,
    sync::{Mutex, PoisonError},
};

/// One set of weights, with what the decoder makes of them.
#[derive(Clone, Copy)]
pub(super) struct Model<'a> {
    pub(super) rit: &'a Rit,
    pub(super) params: &'a [f32],
    pub(super) tables: &'a Tables,
}

/// What of a shard lasts from one part of the update to the next.
#[derive(Default)]
pub(super) struct Shard {
    pub(super) rows: Rows,
    /// The online task encoder's part, with z.
    pub(super) task_encoder: TaskEncoderState,
    /// Loss's gradient by z, (agent rows, h_z): the contrastive loss adds its own before backward does.
    pub(super) d_representation: Vec<f32>,
    pub(super) grads: Vec<f32>,
    pub(super) td_loss: f64,
    pub(super) contrastive_loss: f64,
    pub(super) q_total_sum: f64,
    pub(super) target_sum: f64,
}

/// What a thread needs while it works on a shard, whichever that is.
#[derive(Default)]
pub(super) struct Worker {
    online: Networks,
    target_task_encoder: TaskEncoderState,
    target: Networks,
    /// The online network's greedy action of each agent row.
    greedy: Vec<u8>,
    /// TD target of each group; 0 where not filled.
    td_targets: Vec<f32>,
    /// Loss's gradient by Q_total of each group.
    d_total: Vec<f32>,
    pub(super) scratch: Scratch,
}

/// As many workers as threads have worked at once.
#[derive(Default)]
pub(super) struct Workers(Mutex<Vec<Worker>>);

impl Workers {
    pub(super) fn with<T>(&self, work: impl FnOnce(&mut Worker) -> T) -> T {
        // Nothing that could panic happens under the lock.
        let idle = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let taken = idle().pop();
        let mut worker = taken.unwrap_or_default();
        let result = work(&mut worker);
        idle().push(worker);
        result
    }
}

impl Worker {
    /// All of the target network that needs no actions. It goes nowhere backward, so its encoders and its GRUs share
    /// their buffers: that much less to push through the cache.
    fn prepare_target(&mut self, Model { rit, params, tables }: Model<'_>, rows: &Rows) {
        let Self {
            target_task_encoder: task_encoder, target: Networks { utility, mixer, .. }, scratch, ..
        } = self;
        rit.represent(params, rows, None, task_encoder, scratch);
        let z = rit.representation(&task_encoder.representation);
        mem::swap(&mut task_encoder.encoder, &mut utility.encoder);
        mem::swap(&mut task_encoder.gru, &mut utility.gru);
        rit.utility.forward(params, tables, rows, None, z, utility, scratch);
        mem::swap(&mut utility.encoder, &mut mixer.encoder);
        if let Some(network) = &rit.mixer {
            network.prepare(params, rows, z, mixer);
        }
        // Back to where the next shard begins.
        mem::swap(&mut mixer.encoder, &mut task_encoder.encoder);
        mem::swap(&mut utility.gru, &mut task_encoder.gru);
    }
}

impl Shard {
    /// Lays out the rows of these episodes and makes their task representations.
    pub(super) fn represent(
        &mut self,
        online: Model<'_>,
        episodes: &[&Episode],
        terminal_states: TerminalStates,
        worker: &mut Worker,
    ) {
        let rit = online.rit;
        self.grads.clear();
        self.grads.resize(online.params.len(), 0.0);
        (self.td_loss, self.contrastive_loss, self.q_total_sum, self.target_sum) = (0.0, 0.0, 0.0, 0.0);
        self.rows.fill_from_episodes(episodes, terminal_states);
        self.d_representation.clear();
        if self.rows.groups.is_empty() {
            return;
        }
        rit.represent(online.params, &self.rows, None, &mut self.task_encoder, &mut worker.scratch);
        self.d_representation.resize(self.rows.agent_rows() * rit.config.representation_dim(), 0.0);
    }

    /// Both networks forward, the greedy pass, targets, and the TD loss with its gradient by Q_total. `filled`
    /// counts the whole batch's steps.
    pub(super) fn forward(
        &mut self,
        [online, target]: [Model<'_>; 2],
        gamma: f32,
        filled: usize,
        worker: &mut Worker,
    ) {
        let (rit, rows) = (online.rit, &self.rows);
        if rows.groups.is_empty() {
            return;
        }
        // The target network goes first, as far as it can: what backward needs of the online one is fresher then.
        worker.prepare_target(target, rows);
        let scratch = &mut worker.scratch;
        let z = rit.representation(&self.task_encoder.representation);
        rit.prepare(online.params, online.tables, rows, z, &mut worker.online, scratch);
        worker.greedy.resize(rows.agent_rows(), 0);
        let decoder = &mut worker.online.utility.decoder;
        rit.utility.decoder.greedy(online.params, online.tables, rows, decoder, &mut worker.greedy);
        // The greedy pass's utilities make room for those of the actions taken, which backward needs.
        rit.value(online.params, online.tables, rows, &rows.actions, &mut worker.online);
        rit.value(target.params, target.tables, rows, &worker.greedy, &mut worker.target);

        worker.d_total.clear();
        worker.td_targets.clear();
        for (group, step) in rows.steps.iter().enumerate() {
            if !step.filled {
                worker.d_total.push(0.0);
                worker.td_targets.push(0.0);
                continue;
            }
            let next = rows.next_group(group).map_or(0.0, |next| worker.target.q_total[next]);
            let td_target = td::target(step.reward, gamma, step.terminated, next);
            let q_total = worker.online.q_total[group];
            let (loss, d_total) = td::squared_error(td_target, q_total, filled);
            self.td_loss += loss;
            self.q_total_sum += f64::from(q_total);
            self.target_sum += f64::from(td_target);
            worker.d_total.push(d_total);
            worker.td_targets.push(td_target);
        }
    }

    /// From the gradients by Q_total and by z to those of all parameters but the discriminator's.
    pub(super) fn backward(&mut self, online: Model<'_>, worker: &mut Worker) {
        let Self { rows, task_encoder, d_representation, grads, .. } = self;
        let Worker { online: state, d_total, scratch, .. } = worker;
        let Model { rit, params, tables } = online;
        if rows.groups.is_empty() {
            return;
        }
        let (z, n_actions) = (rit.config.representation_dim(), rit.config.n_actions);
        let mut d_q = scratch.take(rows.agent_rows());
        if let Some(mixer) = &rit.mixer {
            let d_z = dense_mut(d_representation, z);
            let (chosen, state) = (&state.chosen, &mut state.mixer);
            mixer.backward(params, rows, chosen, state, d_total, &mut d_q, d_z, grads, scratch);
        } else {
            for (group, &d_total) in rows.groups.iter().zip(&*d_total) {
                d_q[group.queries.clone()].fill(d_total);
            }
        }
        let mut d_utilities = scratch.take_zeros(rows.agent_rows() * n_actions);
        for (row, (&action, &d_q)) in rows.actions.iter().zip(d_q.iter()).enumerate() {
            d_utilities[row * n_actions + usize::from(action)] = d_q;
        }
        rit.utility.backward(
            params,
            tables,
            rows,
            rit.representation(&task_encoder.representation),
            &mut state.utility,
            View::dense(&d_utilities, n_actions),
            dense_mut(d_representation, z),
            grads,
            scratch,
        );
        scratch.give(d_q);
        scratch.give(d_utilities);
        if let Some(network) = &rit.task_encoder {
            let d_z = View::dense(d_representation, z);
            network.backward(params, rows, task_encoder, d_z, grads, scratch);
        }
    }

    /// What the networks said in each state of the shard, after [`Shard::forward`]. The shard's first episode is the
    /// batch's `first`.
    pub(super) fn seen<'a>(
        &'a self,
        rit: &'a Rit,
        first: usize,
        worker: &'a Worker,
    ) -> impl Iterator<Item = Seen<'a>> {
        let config = &rit.config;
        self.rows.steps.iter().zip(&self.rows.groups).enumerate().map(move |(group, (step, rows))| {
            fn of<'a, T>(data: &'a [T], rows: &Range<usize>, width: usize) -> &'a [T] {
                &data[rows.start * width..rows.end * width]
            }
            let Worker { online, target, greedy, td_targets, .. } = worker;
            let (rows, z) = (&rows.queries, &self.task_encoder.representation);
            Seen {
                episode: first + step.episode,
                time: step.time,
                history: of(online.utility.history(), rows, config.hidden_dim),
                task_representation: of(z, rows, config.representation_dim()),
                utilities: of(&online.utility.decoder.utilities, rows, config.n_actions),
                greedy_actions: of(greedy, rows, 1),
                q_total: online.q_total[group],
                target_q_total: target.q_total[group],
                td_target: td_targets[group],
            }
        })
    }
}

/// What the networks said in one state of a batch: for comparison with other implementations.
#[derive(Clone, Copy, Debug)]
pub struct Seen<'a> {
    /// The episode's place in the batch.
    pub episode: usize,
    /// Decision step.
    pub time: usize,
    /// τ, `[n, h]`.
    pub history: &'a [f32],
    /// z, `[n, h_z]`.
    pub task_representation: &'a [f32],
    /// Q given the actions taken, `[n, A]`.
    pub utilities: &'a [f32],
    /// The online network's greedy joint action, `[n]`.
    pub greedy_actions: &'a [u8],
    /// Q_total of the actions taken.
    pub q_total: f32,
    /// The target network's Q_total of the greedy joint action.
    pub target_q_total: f32,
    /// The TD target; 0 in a bootstrap state.
    pub td_target: f32,
}

/// A dense matrix that may have no columns.
fn dense_mut(data: &mut [f32], cols: usize) -> ViewMut<'_> {
    if cols == 0 {
        ViewMut { data: &mut [], rows: 0, cols: 0, stride: 0 }
    } else {
        ViewMut::dense(data, cols)
    }
}
