//! Games that a step of an episode makes of its agents, and what the networks say of each agent.
//!
//! The value of a coalition C at a step: what the joint action is worth in which members take the actions that they took,
//! and all others the *default* action, the first that is available to them (in particle worlds standing still, in combat
//! the no-op of the dead and stopping of the living, in matrix games a¹). Two games give it a worth:
//! the *learned* one, Q_total of the joint action in the state, with the histories of the actions taken; and the
//! environment's *own*, the return from that step on where the greedy team goes on after it, with the episode's own
//! random streams. The paper defines values likewise (section V, equation 7), without saying what others do.

use crate::{failure::Failure, player::Trained};
use rit_env::Task;
use rit_episode::{Action, Episode, Policy, RunSeed, Turn};
use rit_learner::evaluation::Evaluator;

/// A step of an episode.
#[derive(Debug)]
pub struct StepGame {
    /// The learned game: Q_total of each coalition.
    pub learned: Vec<f64>,
    /// The environment's own: the return from this step on; empty where it was not rolled.
    pub own: Vec<f64>,
    /// What the step paid.
    pub reward: f64,
    /// The return from this step on, as the episode went.
    pub return_to_go: f64,
    /// Each agent's utility by decision order, in the order of the orders: `[orders][agent]`. The episode's own order
    /// comes first.
    pub utilities: Vec<Vec<f64>>,
}

/// The joint actions `[T, n]` of a coalition at every step.
fn joint(episode: &Episode, coalition: usize) -> Vec<Action> {
    let n = episode.n_agents;
    let actions = episode.available.len() / ((episode.steps() + 1) * n);
    let default = |row: usize| {
        let available = &episode.available[row * actions..][..actions];
        available.iter().position(|&it| it != 0).unwrap_or(0) as Action
    };
    let taken = |(row, &action): (usize, &Action)| {
        if coalition >> (row % n) & 1 == 1 { action } else { default(row) }
    };
    episode.actions.iter().enumerate().map(taken).collect()
}

/// The learned game of every step, with utilities by these decision orders (rows of the episode), in the rewards' unit.
///
/// # Errors
/// When the method has no utilities.
pub fn learned(
    trained: &Trained,
    episode: &Episode,
    orders: &[Vec<usize>],
) -> Result<Vec<StepGame>, Failure> {
    let n = episode.n_agents;
    // What was learned of scaled rewards is compared with rewards.
    let in_rewards = |value: f32| f64::from(value) / f64::from(trained.config.algorithm.reward_scale);
    let value = |episode: &Episode, actions: &[Action]| {
        trained.model.value(&trained.params, episode, actions).ok_or_else(|| {
            let method = trained.model.method().facts().name;
            Failure::input_message(format!(
                "{method} has no utilities that can be compared with Shapley values; RIT, its ablations, qmix-…, vdn-… and \
                 updet-… have"
            ))
        })
    };
    let mut steps: Vec<StepGame> = (0..episode.steps())
        .map(|step| StepGame {
            learned: Vec::new(),
            own: Vec::new(),
            reward: f64::from(episode.rewards[step]),
            return_to_go: episode.rewards[step..].iter().map(|&reward| f64::from(reward)).sum(),
            utilities: Vec::new(),
        })
        .collect();
    for coalition in 0..1 << n {
        let q_total = value(episode, &joint(episode, coalition))?.q_total;
        for (step, q_total) in steps.iter_mut().zip(q_total) {
            step.learned.push(in_rewards(q_total));
        }
    }
    for order in orders {
        let other = episode.reordered(order);
        let utilities = value(&other, &other.actions)?.utilities;
        for (step, of_step) in steps.iter_mut().zip(utilities.chunks_exact(n)) {
            let mut by_agent = vec![0.0; n];
            for (&agent, &utility) in order.iter().zip(of_step) {
                by_agent[agent] = in_rewards(utility);
            }
            step.utilities.push(by_agent);
        }
    }
    Ok(steps)
}

/// The environment's own game of a step: every coalition's continuation is rolled from the episode's beginning.
///
/// # Errors
/// When the environment cannot go on.
pub fn own(
    trained: &Trained,
    task: Task,
    episode: &Episode,
    seed: RunSeed,
    step: usize,
) -> Result<Vec<f64>, Failure> {
    let evaluator = Evaluator::new(&trained.config);
    let n = episode.n_agents;
    let of_coalition = |coalition: usize| {
        let at = step * n;
        let mut policy = Imagined {
            inner: trained.policy(),
            past: episode.actions[..at].to_vec(),
            now: joint(episode, coalition)[at..at + n].to_vec(),
            step: 0,
        };
        let numbers = episode.number..episode.number + 1;
        let rolled = evaluator.watch(&mut policy, task, numbers, seed, |_, _| {})?;
        let rewards = rolled.first().map_or(&[][..], |rolled| &rolled.rewards[..]);
        Ok(rewards.iter().skip(step).map(|&reward| f64::from(reward)).sum())
    };
    (0..1 << n).map(of_coalition).collect()
}

/// A policy that first repeats what was done, then does something else once, then goes on by itself.
struct Imagined {
    inner: Box<dyn Policy>,
    past: Vec<Action>,
    now: Vec<Action>,
    step: usize,
}

impl Policy for Imagined {
    fn begin(&mut self, slot: usize, n_agents: usize) {
        self.step = 0;
        self.inner.begin(slot, n_agents);
    }

    fn act(&mut self, turns: &mut [Turn<'_>]) {
        // What agents remember comes from here.
        self.inner.act(turns);
        let n = self.now.len();
        let done = [&self.past[..], &self.now[..]].concat();
        if let Some(joint) = done.get(self.step * n..(self.step + 1) * n) {
            turns.iter_mut().for_each(|turn| turn.actions.copy_from_slice(joint));
        }
        self.step += 1;
    }
}
