//! The contrastive loss over a whole batch, across all shards.

use super::shards::Workers;
use crate::{Rows, blocks::Discriminator};
use rayon::prelude::*;
use rit_nn::{View, ViewMut};

/// Buffers of the contrastive loss. With N filled agent rows:
#[derive(Default)]
pub(super) struct Pairs {
    /// (shard, agent row, task) in the order (episode, step, agent).
    rows: Vec<(usize, usize, usize)>,
    /// `inverse[pairing[i]] = i`.
    inverse: Vec<usize>,
    /// [z_i ‖ z_π(i)], `[N, 2 h_z]`.
    pairs: Vec<f32>,
    d_pairs: Vec<f32>,
    same: Vec<bool>,
}

/// A shard's part of the contrastive loss.
pub(super) struct PairsShard<'a> {
    pub(super) rows: &'a Rows,
    /// z, (R, h_z).
    pub(super) representation: View<'a>,
    /// Loss's gradient by z, `[R, h_z]`, to be added to.
    pub(super) d_representation: &'a mut [f32],
    /// The parameters' gradients, to be added to.
    pub(super) grads: &'a mut [f32],
    /// L_C's share.
    pub(super) loss: &'a mut f64,
}

impl Pairs {
    /// L_C over all filled agent rows of the batch, left in the shards' parts of it together with its gradients by the
    /// discriminator's parameters and by z.
    pub(super) fn loss(
        &mut self,
        discriminator: &Discriminator,
        params: &[f32],
        mut shards: Vec<PairsShard<'_>>,
        workers: &Workers,
        pairing: impl FnOnce(usize) -> Vec<usize>,
    ) {
        let Self { rows, inverse, pairs, d_pairs, same } = self;
        rows.clear();
        for (index, shard) in shards.iter().enumerate() {
            rows.extend(shard.rows.filled_agent_rows().map(|(row, step)| (index, row, step.task)));
        }
        let (count, z) = (rows.len(), discriminator.representation_dim());
        let pairing = pairing(count);
        inverse.resize(count, 0);
        pairs.clear();
        same.clear();
        let representation = |i: usize| {
            let (shard, row, _) = rows[i];
            shards[shard].representation.row(row)
        };
        for (i, &partner) in pairing.iter().enumerate() {
            inverse[partner] = i;
            pairs.extend_from_slice(representation(i));
            pairs.extend_from_slice(representation(partner));
            same.push(rows[i].2 == rows[partner].2);
        }
        d_pairs.resize(count * 2 * z, 0.0);

        // Parts as many as shards, in the pairs' order; a part's gradients go into the shard of the same place.
        let share = count.div_ceil(shards.len().max(1)).max(1);
        let parts =
            pairs.chunks(share * 2 * z).zip(d_pairs.chunks_mut(share * 2 * z)).zip(same.chunks(share));
        let parts: Vec<_> = shards.iter_mut().zip(parts).collect();
        parts.into_par_iter().for_each(|(shard, ((pairs, d_pairs), same))| {
            let (from, to) = (View::dense(pairs, 2 * z), ViewMut::dense(d_pairs, 2 * z));
            let sum = workers.with(|worker| {
                let work = &mut worker.online.work;
                discriminator.loss(params, from, same, count, to, shard.grads, work)
            });
            *shard.loss = sum / count as f64;
        });

        for (i, &(shard, row, _)) in rows.iter().enumerate() {
            // Row i is the first of its own pair and the second of another.
            let (first, second) = (&d_pairs[i * 2 * z..][..z], &d_pairs[inverse[i] * 2 * z + z..][..z]);
            let d_z = &mut shards[shard].d_representation[row * z..][..z];
            for ((d_z, first), second) in d_z.iter_mut().zip(first).zip(second) {
                *d_z += first + second;
            }
        }
    }
}
