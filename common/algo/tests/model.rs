//! The whole model on small random batches: numeric gradients of every parameter, acting against training,
//! and independence of threads and of company.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

use rand::RngExt as _;
use rit_algo::{
    Mixing, Rit, RitActing, RitConfig, Seen, TaskRepresentations, TerminalStates, Update, UpdateConfig,
    contrastive::draw_pairing,
};
use rit_episode::{
    Choice, End, Episode, Exploration, Observation, Policy, Rng, RunSeed, Stream, Turn, decision_order,
};
use rit_nn::{OptimizerKind, gradcheck};
use std::{
    collections::HashMap,
    sync::{Arc, Mutex},
};

const D: usize = 5;
const A: usize = 3;

fn config(n_heads: usize, task_representations: bool, mixing_network: bool) -> RitConfig {
    RitConfig {
        entity_dim: D,
        n_actions: A,
        hidden_dim: 6,
        attention_dim: 4,
        n_heads,
        task_representations: task_representations
            .then_some(TaskRepresentations { dim: 3, reward_embed_dim: 2 }),
        mixing: if mixing_network {
            Mixing::Network { mixing_embed_dim: 4, hypernet_embed_dim: 5 }
        } else {
            Mixing::Sum
        },
    }
}

/// An episode of random content: blind and partly blind agents, unavailable actions.
fn episode(task: usize, n: usize, m: usize, steps: usize, end: End, rng: &mut Rng) -> Episode {
    let mut available: Vec<u8> = (0..(steps + 1) * n * A).map(|_| rng.random_range(0..2)).collect();
    let actions: Vec<u8> = (0..steps * n).map(|_| rng.random_range(0..A) as u8).collect();
    for (row, &action) in actions.iter().enumerate() {
        available[row * A + usize::from(action)] = 1;
    }
    Episode {
        number: 0,
        weights_version: 0,
        task,
        n_agents: n,
        n_entities: m,
        decision_order: decision_order::identity(n),
        entities: (0..(steps + 1) * m * D).map(|_| rng.random_range(-1.0..1.0)).collect(),
        observable: (0..(steps + 1) * n * m).map(|_| u8::from(rng.random_range(0..3) > 0)).collect(),
        available,
        actions,
        rewards: (0..steps).map(|_| rng.random_range(-1.0..1.0)).collect(),
        shaping: vec![0.0; steps],
        end,
        won: false,
    }
}

/// Tasks of different sizes, lengths and ends.
fn batch(seed: u64) -> Vec<Episode> {
    let rng = &mut RunSeed(seed).stream(Stream::Environment, 0);
    vec![
        episode(0, 2, 3, 3, End::Terminated, rng),
        episode(1, 3, 5, 2, End::Truncated, rng),
        episode(0, 2, 3, 1, End::Terminated, rng),
        episode(2, 1, 1, 3, End::Truncated, rng),
        episode(1, 3, 5, 3, End::Truncated, rng),
    ]
}

fn update(rit: &Arc<Rit>, shards: usize, threads: usize, params: Vec<f32>) -> Update {
    let optimizer = OptimizerKind::Adam { beta1: 0.9, beta2: 0.999, eps: 1e-8 };
    let terminal_states = TerminalStates::LeftOut;
    let config = UpdateConfig {
        gamma: 0.9,
        lr: 1e-2,
        optimizer,
        grad_norm_clip: 10.0,
        shards,
        threads,
        terminal_states,
    };
    Update::new(Arc::clone(rit), config, params).unwrap()
}

/// Parameters large enough that no gradient hides in rounding.
fn params(rit: &Rit, seed: u64) -> Vec<f32> {
    gradcheck::noise(seed, rit.layout.len()).iter().map(|x| 0.7 * x).collect()
}

#[test]
fn every_parameters_gradient_is_the_numeric_one() {
    for (heads, representations, network) in
        [(1, true, true), (2, true, true), (2, false, true), (2, true, false), (1, false, false)]
    {
        let rit = Arc::new(Rit::new(config(heads, representations, network)).unwrap());
        let episodes = batch(7);
        let batch: Vec<&Episode> = episodes.iter().collect();
        let at = params(&rit, 4);
        let mut update = update(&rit, 2, 1, at.clone());
        // The target stays where it is while the online parameters move.
        update.target = gradcheck::noise(5, update.target.len());
        let pairing = |rows| draw_pairing(rows, &mut RunSeed(1).stream(Stream::Pairing, 0));
        update.gradients(&batch, pairing);
        let grads = update.grads().to_vec();
        let mut moved = at.clone();
        for param in rit.layout.params() {
            let range = param.range.clone();
            if param.name.ends_with("attention.key.bias") {
                // Softmax does not see what is added to every score: the true gradient is zero.
                let largest = grads[range].iter().fold(0.0_f32, |largest, g| largest.max(g.abs()));
                assert!(largest < 1e-5, "{}: {largest}", param.name);
                continue;
            }
            let cell = std::cell::RefCell::new((&mut update, &mut moved));
            gradcheck::check(&param.name, &at[range.clone()], &grads[range.clone()], |values| {
                let (update, moved) = &mut *cell.borrow_mut();
                moved[range.clone()].copy_from_slice(values);
                update.params.copy_from_slice(moved);
                let losses = update.gradients(&batch, pairing);
                moved[range.clone()].copy_from_slice(&at[range.clone()]);
                losses.td_loss + losses.contrastive_loss
            });
        }
    }
}

/// Plays an episode's observations to a policy, step by step, and forces the recorded actions by making
/// nothing else available.
fn replay(acting: &mut RitActing, slots: &[(usize, &Episode)]) -> Vec<Vec<f32>> {
    let mut utilities = vec![vec![]; slots.len()];
    for &(slot, episode) in slots {
        acting.begin(slot, episode.n_agents);
    }
    let longest = slots.iter().map(|(_, episode)| episode.steps()).max().unwrap_or(0);
    for time in 0..longest {
        let running: Vec<usize> = (0..slots.len()).filter(|&i| time < slots[i].1.steps()).collect();
        let mut seen: Vec<(Observation, Vec<u8>, Exploration)> = running
            .iter()
            .map(|&i| {
                let episode = slots[i].1;
                let (n, m) = (episode.n_agents, episode.n_entities);
                let mut observation = Observation::new(n, m, D, A);
                for row in 0..m {
                    observation
                        .entity_mut(row)
                        .copy_from_slice(&episode.entities[(time * m + row) * D..][..D]);
                }
                for agent in 0..n {
                    let row = time * n + agent;
                    observation.observable_mut(agent).copy_from_slice(&episode.observable[row * m..][..m]);
                    observation.available_mut(agent)[usize::from(episode.actions[row])] = 1;
                }
                (
                    observation,
                    vec![0; n],
                    Exploration::new(Choice::Greedy, 0.0, n, RunSeed(0).stream(Stream::Exploration, 0)),
                )
            })
            .collect();
        let mut turns: Vec<Turn<'_>> = seen
            .iter_mut()
            .zip(&running)
            .map(|((observation, actions, exploration), &i)| Turn {
                slot: slots[i].0,
                observation,
                previous_reward: if time == 0 { 0.0 } else { slots[i].1.rewards[time - 1] },
                exploration,
                actions,
            })
            .collect();
        acting.act(&mut turns);
        let mut rest = acting.utilities();
        for &i in &running {
            let (mine, others) = rest.split_at(slots[i].1.n_agents * A);
            utilities[i].extend_from_slice(mine);
            rest = others;
        }
    }
    utilities
}

#[test]
fn acting_row_by_row_equals_the_masked_parallel_pass() {
    for representations in [true, false] {
        let rit = Arc::new(Rit::new(config(2, representations, true)).unwrap());
        let at = params(&rit, 3);
        let episodes = batch(11);
        let batch: Vec<&Episode> = episodes.iter().collect();
        let mut update = update(&rit, 1, 1, at.clone());
        let trained = Mutex::new(HashMap::new());
        let see = |states: &mut dyn Iterator<Item = Seen<'_>>| {
            let utilities = states.map(|seen| ((seen.episode, seen.time), seen.utilities.to_vec()));
            trained.lock().unwrap().extend(utilities);
        };
        update.gradients_seen(&batch, |rows| (0..rows).collect(), see);
        let trained = trained.into_inner().unwrap();
        let mut acting = RitActing::new(Arc::clone(&rit), &at[rit.acting()]);
        let slots: Vec<_> = batch.iter().copied().enumerate().collect();
        for ((index, episode), acted) in slots.iter().zip(replay(&mut acting, &slots)) {
            for time in 0..episode.steps() {
                let trained = &trained[&(*index, time)];
                let acted = &acted[time * episode.n_agents * A..][..episode.n_agents * A];
                for (a, b) in acted.iter().zip(trained) {
                    assert!((a - b).abs() <= 1e-5 * b.abs().max(1.0), "episode {index} step {time}: {a} {b}");
                }
            }
        }
    }
}

#[test]
fn acting_does_not_depend_on_company() {
    let rit = Arc::new(Rit::new(config(2, true, true)).unwrap());
    let at = params(&rit, 3);
    let episodes = batch(13);
    let together: Vec<_> = episodes.iter().enumerate().collect();
    let all = replay(&mut RitActing::new(Arc::clone(&rit), &at[rit.acting()]), &together);
    for (index, episode) in episodes.iter().enumerate() {
        let alone = replay(&mut RitActing::new(Arc::clone(&rit), &at[rit.acting()]), &[(3, episode)]);
        assert_eq!(alone[0], all[index], "episode {index}, bit for bit");
    }
}

/// A batch need not fill every shard, nor fill them evenly.
#[test]
fn shards_without_episodes_add_nothing() {
    let rit = Arc::new(Rit::new(config(1, true, true)).unwrap());
    let episodes = batch(17);
    let batch: Vec<&Episode> = episodes.iter().collect();
    let grads = |shards| {
        let mut update = update(&rit, shards, 2, params(&rit, 4));
        let losses = update.gradients(&batch, |rows| (0..rows).rev().collect());
        (losses, update.grads().to_vec())
    };
    let (losses, five) = grads(5);
    // Eight shards of one episode at most; four, of two at most.
    for shards in [8, 4] {
        let (other, grads) = grads(shards);
        assert!((losses.td_loss - other.td_loss).abs() < 1e-6, "{losses:?} {other:?}");
        for (a, b) in grads.iter().zip(&five) {
            assert!((a - b).abs() < 1e-4 * b.abs().max(1.0), "{shards} shards: {a} {b}");
        }
    }
}

#[test]
fn threads_change_no_bit() {
    let rit = Arc::new(Rit::new(config(2, true, true)).unwrap());
    let run = |threads| {
        let mut update = update(&rit, 3, threads, params(&rit, 3));
        for step in 0..5 {
            let episodes = batch(step);
            let rng = &mut RunSeed(9).stream(Stream::Pairing, step);
            update.step(&episodes.iter().collect::<Vec<_>>(), rng);
            update.update_target();
        }
        update.params
    };
    let alone = run(1);
    assert_eq!(alone, run(2));
    assert_eq!(alone, run(4));
}
