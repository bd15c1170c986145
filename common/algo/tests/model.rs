//! The whole model on small random batches: numeric gradients of every parameter, acting against training,
//! and independence of threads and of company.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]
#![allow(clippy::let_unit_value, reason = "some methods draw nothing")]

#[path = "model/networks.rs"]
#[macro_use]
mod networks;

use networks::{A, CASES, D, Drawn, Networks, batch, measure};
use rit_algo::{
    Learner as _, Method,
    blocks::draw_pairing,
    drive::{SeenShard, TdLearner, ValueActing, ValueNetwork},
    learner::Draw,
    methods::{Recurrent, Refil, Roma, Updet},
};
use rit_episode::{Choice, Episode, Exploration, Observation, Policy, RunSeed, Stream, Turn};
use rit_nn::gradcheck;
use std::{collections::HashMap, sync::Mutex};

#[test]
fn every_parameters_gradient_is_the_numeric_one() {
    // Half of the cases have every part.
    each!(CASES.iter().step_by(2), |networks| {
        let case = networks.case;
        let episodes = batch(7);
        let batch: Vec<&Episode> = episodes.iter().collect();
        let draws = networks.draws(&batch);
        let pairing = |rows| draw_pairing(rows, &mut RunSeed(1).stream(Stream::Pairing, 0));
        let gradients = |seed| {
            let mut learner = networks.learner(2, 1, networks.params(seed));
            // The target stays where it is while the online parameters move.
            learner.target = gradcheck::noise(5, learner.target.len());
            learner.gradients(&batch, &draws, pairing);
            learner
        };
        // So small a layer's ReLUs may all be dead, which shows nothing.
        let shows = |learner: &TdLearner<_>| {
            let layout = networks.model.layout();
            let live = |name: &str| !name.ends_with("attention.key.bias");
            let mut params = layout.params().iter().filter(|param| live(&param.name));
            params.all(|param| learner.grads()[param.range.clone()].iter().any(|&g| g != 0.0))
        };
        let Some(mut learner) = (0..50).map(gradients).find(shows) else { panic!("{case:?}: dead") };
        let (at, grads) = (learner.params.clone(), learner.grads().to_vec());
        let mut moved = at.clone();
        for param in networks.model.layout().params() {
            let range = param.range.clone();
            if param.name.ends_with("attention.key.bias") {
                // Softmax does not see what is added to every score: the true gradient is zero.
                let largest = grads[range].iter().fold(0.0_f32, |largest, g| largest.max(g.abs()));
                assert!(largest < 1e-5, "{case:?} {}: {largest}", param.name);
                continue;
            }
            let cell = std::cell::RefCell::new((&mut learner, &mut moved));
            let name = format!("{case:?} {}", param.name);
            gradcheck::check(&name, &at[range.clone()], &grads[range.clone()], |values| {
                let (learner, moved) = &mut *cell.borrow_mut();
                moved[range.clone()].copy_from_slice(values);
                learner.params.copy_from_slice(moved);
                let values = learner.gradients(&batch, &draws, pairing);
                moved[range.clone()].copy_from_slice(&at[range.clone()]);
                whole_loss(learner, &values)
            });
        }
    });
}

fn whole_loss<N: Drawn>(learner: &TdLearner<N>, values: &[f64]) -> f64 {
    N::loss(|name| measure(learner, values, name))
}

/// Plays an episode's observations to a policy, step by step, and forces the recorded actions by making
/// nothing else available.
fn replay<N: ValueNetwork>(acting: &mut ValueActing<N>, slots: &[(usize, &Episode)]) -> Vec<Vec<f32>> {
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

/// What a learner's online network says of a batch, by (episode, time): utilities `[n, A]` and Q_total.
fn said<N: Drawn>(
    learner: &mut TdLearner<N>,
    batch: &[&Episode],
    draws: &N::Draws,
) -> HashMap<(usize, usize), (Vec<f32>, f32)> {
    let said = Mutex::new(HashMap::new());
    let see = |seen: &SeenShard<'_>| {
        let values: HashMap<_, _> = seen.values().collect();
        let groups = seen.rows.steps.iter().zip(&seen.rows.groups).enumerate();
        said.lock().unwrap().extend(groups.map(|(group, (step, rows))| {
            let utilities = rows.queries.clone().flat_map(|row| values["utilities"].row(row).to_vec());
            let q_total = values["q_total"].row(group)[0];
            ((seen.first_episode + step.episode, step.time), (utilities.collect(), q_total))
        }));
    };
    learner.gradients_seen(batch, draws, |rows| (0..rows).collect(), see);
    said.into_inner().unwrap()
}

#[test]
fn acting_step_by_step_equals_the_parallel_pass() {
    each!(&CASES, |networks| {
        let case = networks.case;
        let at = networks.params(3);
        let episodes = batch(11);
        let batch: Vec<&Episode> = episodes.iter().collect();
        let mut draws = networks.draws(&batch);
        networks.quiet(&mut draws);
        let trained = said(&mut networks.learner(1, 1, at.clone()), &batch, &draws);
        let slots: Vec<_> = batch.iter().copied().enumerate().collect();
        for ((index, episode), acted) in slots.iter().zip(replay(&mut networks.acting(&at), &slots)) {
            for time in 0..episode.steps() {
                let (trained, _) = &trained[&(*index, time)];
                let acted = &acted[time * episode.n_agents * A..][..episode.n_agents * A];
                for (a, b) in acted.iter().zip(trained) {
                    let close = (a - b).abs() <= 1e-5 * b.abs().max(1.0);
                    assert!(close, "{case:?} episode {index} step {time}: {a} {b}");
                }
            }
        }
    });
}

#[test]
fn acting_does_not_depend_on_company() {
    each!(&CASES, |networks| {
        let case = networks.case;
        let at = networks.params(3);
        let episodes = batch(13);
        let together: Vec<_> = episodes.iter().enumerate().collect();
        let all = replay(&mut networks.acting(&at), &together);
        for (index, episode) in episodes.iter().enumerate() {
            let alone = replay(&mut networks.acting(&at), &[(3, episode)]);
            assert_eq!(alone[0], all[index], "{case:?} episode {index}, bit for bit");
        }
    });
}

/// Values of an episode that is over are those that acting had, and where utilities are summed, Q_total is their sum.
#[test]
fn values_of_an_episode_are_those_that_acting_had() {
    each!(&CASES, |networks| {
        let at = networks.params(3);
        let episodes = batch(17);
        let sums = [Method::RitVdn, Method::VdnAttn, Method::VdnInt, Method::UpdetVdn];
        let slots: Vec<_> = episodes.iter().enumerate().collect();
        for (episode, acted) in episodes.iter().zip(replay(&mut networks.acting(&at), &slots)) {
            let Some(values) = networks.model.value(&at, episode, &episode.actions) else {
                assert!([Method::Refil, Method::Roma].contains(&networks.case.0));
                continue;
            };
            let n = episode.n_agents;
            for (row, &action) in episode.actions.iter().enumerate() {
                let (a, b) = (values.utilities[row], acted[row * A + usize::from(action)]);
                assert!((a - b).abs() <= 1e-5 * b.abs().max(1.0), "{:?} row {row}: {a} {b}", networks.case);
            }
            let sum_of = |step: usize| values.utilities[step * n..][..n].iter().sum::<f32>();
            for (step, &q_total) in values.q_total.iter().enumerate() {
                let is_sum = (q_total - sum_of(step)).abs() < 1e-4;
                assert!(is_sum || !sums.contains(&networks.case.0), "{:?}: {q_total}", networks.case);
            }
            let has_tasks = networks.case.0.facts().task_representations;
            assert_eq!(values.representations.is_empty(), !has_tasks);
        }
    });
}

/// Where decisions are made at once, agents are alike: their order moves utilities with them, and Q_total and the loss
/// stay. Where they are made in order, the order shows.
#[test]
fn reordering_agents_reorders_utilities_and_no_more() {
    each!(&CASES, |networks| {
        let case = networks.case;
        let mut learner = networks.learner(1, 1, networks.params(3));
        let episodes = batch(19);
        let orders: Vec<Vec<usize>> =
            episodes.iter().map(|episode| (0..episode.n_agents).rev().collect()).collect();
        let others: Vec<Episode> =
            episodes.iter().zip(&orders).map(|(episode, order)| episode.reordered(order)).collect();
        let (batch, other) = (episodes.iter().collect::<Vec<_>>(), others.iter().collect::<Vec<_>>());
        let draws = networks.draws(&batch);
        let mut of_other = networks.draws(&batch);
        networks.reorder(&mut of_other, &orders);
        let losses = [(&batch, &draws), (&other, &of_other)].map(|(batch, draws)| {
            let mut values = learner.gradients(batch, draws, |rows| (0..rows).collect());
            // Of how task representations are paired, and not of agents' order.
            let contrastive = learner.measures().iter().position(|it| it.name == "contrastive_loss");
            contrastive.into_iter().for_each(|at| values[at] = 0.0);
            values
        });
        let [ours, theirs] = [said(&mut learner, &batch, &draws), said(&mut learner, &other, &of_other)];
        let differences = losses[0].iter().zip(&losses[1]).map(|(a, b)| (a - b).abs() / a.abs().max(1.0));
        let mut largest = differences.fold(0.0, f64::max) as f32;
        for (&(episode, time), (utilities, q_total)) in
            ours.iter().filter(|((episode, time), _)| *time < episodes[*episode].steps())
        {
            let (reordered, other_total) = &theirs[&(episode, time)];
            largest = largest.max((q_total - other_total).abs());
            for (k, &row) in orders[episode].iter().enumerate() {
                for (a, b) in reordered[k * A..][..A].iter().zip(&utilities[row * A..]) {
                    largest = largest.max((a - b).abs());
                }
            }
        }
        if case.0.facts().ordered {
            assert!(largest > 1e-3, "{case:?}: the order of decisions does not show");
        } else {
            assert!(largest < 1e-5, "{case:?}: {largest}");
        }
    });
}

/// A batch need not fill every shard, nor fill them evenly.
#[test]
fn shards_without_episodes_add_nothing() {
    each!(&CASES, |networks| {
        let case = networks.case;
        let episodes = batch(17);
        let batch: Vec<&Episode> = episodes.iter().collect();
        let grads = |shards| {
            let mut learner = networks.learner(shards, 2, networks.params(4));
            let draws = networks.draws(&batch);
            let values = learner.gradients(&batch, &draws, |rows| (0..rows).rev().collect());
            (values[0], learner.grads().to_vec())
        };
        let (loss, five) = grads(5);
        // Eight shards of one episode at most; four, of two at most.
        for shards in [8, 4] {
            let (other, grads) = grads(shards);
            assert!((loss - other).abs() < 1e-6, "{case:?}: {loss} {other}");
            for (a, b) in grads.iter().zip(&five) {
                assert!((a - b).abs() < 1e-4 * b.abs().max(1.0), "{case:?}, {shards} shards: {a} {b}");
            }
        }
    });
}

#[test]
fn threads_change_no_bit() {
    each!(&CASES, |networks| {
        let case = networks.case;
        let run = |threads| {
            let mut learner = networks.learner(3, threads, networks.params(3));
            for step in 0..5 {
                let episodes = batch(step);
                let draw = Draw { seed: RunSeed(9), update: step };
                let batch: Vec<&Episode> = episodes.iter().collect();
                learner.learn(&batch, draw).unwrap();
                learner.update_target();
            }
            learner.params
        };
        let alone = run(1);
        assert_eq!(alone, run(2), "{case:?}");
        assert_eq!(alone, run(4), "{case:?}");
    });
}

#[test]
fn a_reward_scale_makes_targets_of_rewards_so_much_smaller() {
    // Task representations read rewards, whose size is then another.
    let without = CASES.iter().filter(|case| !case.0.facts().task_representations);
    each!(without, |networks| {
        let episodes = batch(3);
        let small: Vec<Episode> = episodes
            .iter()
            .map(|episode| {
                let rewards = episode.rewards.iter().map(|reward| 0.25 * reward).collect();
                Episode { rewards, ..episode.clone() }
            })
            .collect();
        let gradients = |reward_scale, episodes: &[Episode]| {
            let batch: Vec<&Episode> = episodes.iter().collect();
            let mut learner = networks.scaled_learner(reward_scale, networks.params(3));
            let measures = learner.gradients(&batch, &networks.draws(&batch), |rows| (0..rows).collect());
            (measures, learner.grads().to_vec())
        };
        let scaled = gradients(0.25, &episodes);
        assert_eq!(scaled, gradients(1.0, &small), "{:?}", networks.case);
        assert_ne!(scaled, gradients(1.0, &episodes), "{:?}", networks.case);
    });
}

#[test]
fn saturated_units_are_counted_over_decisions() {
    each!(CASES.iter().filter(|case| !matches!(case.0, Method::UpdetMix | Method::UpdetVdn)), |networks| {
        let episodes = batch(5);
        let batch: Vec<&Episode> = episodes.iter().collect();
        // Large weights drive some units to their bounds, and not all.
        let params = networks.params(3).iter().map(|x| 8.0 * x).collect();
        let mut learner = networks.learner(2, 1, params);
        let counted = Mutex::new((0, 0));
        let see = |shard: &SeenShard<'_>| {
            let (_, history) = shard.values().find(|(name, _)| *name == "history").unwrap();
            let mut counted = counted.lock().unwrap();
            for (group, step) in shard.rows.groups.iter().zip(&shard.rows.steps) {
                for row in group.queries.clone().filter(|_| step.filled) {
                    let units = history.row(row);
                    counted.0 += units.iter().filter(|unit| !(-0.99..=0.99).contains(*unit)).count();
                    counted.1 += units.len();
                }
            }
        };
        let values = learner.gradients_seen(&batch, &networks.draws(&batch), |rows| (0..rows).collect(), see);
        let (saturated, units) = *counted.lock().unwrap();
        assert!(0 < saturated && saturated < units, "{:?}: {saturated} of {units}", networks.case);
        let share = measure(&learner, &values, "saturated_units");
        assert_eq!(share, saturated as f64 / units as f64, "{:?}", networks.case);
    });
}

#[test]
fn an_update_clips_by_the_norm_of_the_gradients() {
    each!(&CASES, |networks| {
        let episodes = batch(5);
        let batch: Vec<&Episode> = episodes.iter().collect();
        let draw = Draw { seed: RunSeed(23), update: 0 };
        let mut learned = networks.scaled_learner(30.0, networks.params(3));
        let before = learned.params.clone();
        let values = learned.learn(&batch, draw).unwrap();
        let norm = measure(&learned, &values, "grad_norm");
        assert!(norm > 10.0, "{:?}: {norm} is not clipped", networks.case);
        let (mut expected, mut optimizer) = (before.clone(), learned.optimizer.clone());
        optimizer.mean.fill(0.0);
        optimizer.mean_square.fill(0.0);
        optimizer.steps = 0;
        optimizer.step(&mut expected, learned.grads(), (10.0 / (norm + 1e-6)) as f32);
        assert_ne!(learned.params, before, "{:?}", networks.case);
        assert_eq!(learned.optimizer.mean_square, optimizer.mean_square, "{:?}", networks.case);
        assert_eq!(learned.params, expected, "{:?}", networks.case);
    });
}
