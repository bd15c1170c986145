//! The randomness in the choices of one running episode: ε-greedy exploration, or sampling from the policy.

use crate::{Action, Rng};
use rand::RngExt as _;

/// Which of an episode's actions are random, and what they are.
#[derive(Clone, Debug)]
pub struct Exploration {
    /// Probability of a random action, per agent and step.
    epsilon: f32,
    /// Probability that a random action is the agent's last random one again.
    persistence: f32,
    /// The episode's own stream.
    rng: Rng,
    /// Each agent's last random action.
    last: Vec<Option<Action>>,
    /// Whether actions are sampled from the policy instead.
    samples: bool,
}

impl Exploration {
    /// Of an episode with `n_agents`, from its own stream. Both numbers are probabilities; without
    /// `persistence` the random actions are independent, as in the paper.
    pub fn new(epsilon: f32, persistence: f32, n_agents: usize, rng: Rng) -> Self {
        Self { epsilon, persistence, rng, last: vec![None; n_agents], samples: false }
    }

    /// Of an episode whose actions are sampled from the policy, for policies that have probabilities.
    pub fn sampling(rng: Rng) -> Self {
        Self { samples: true, ..Self::new(0.0, 0.0, 0, rng) }
    }

    /// A number in [0, 1) that says which action of its policy an agent takes, where actions are sampled; to be asked
    /// once for each agent and step, in the agents' order. Nothing is drawn where they are not.
    pub fn sample(&mut self) -> Option<f32> {
        self.samples.then(|| self.rng.random())
    }

    /// The episode's stream, for what a policy itself draws while it explores; `None` with an ε of 0, in evaluation.
    pub fn stream(&mut self) -> Option<&mut Rng> {
        (self.epsilon > 0.0).then_some(&mut self.rng)
    }

    /// A random action for the agent of this row, if it is to explore on this step; to be asked once a step.
    /// `available` has a flag for each action.
    pub fn explore(&mut self, row: usize, available: &[u8]) -> Option<Action> {
        // Drawn whatever ε is, so that the stream stays in step.
        let explores = self.rng.random::<f32>() < self.epsilon;
        explores.then(|| {
            let last = self.last[row].filter(|&last| available[usize::from(last)] != 0);
            let action = match last.filter(|_| self.persists()) {
                Some(last) => last,
                None => self.any(available),
            };
            self.last[row] = Some(action);
            action
        })
    }

    /// Any available action, each as likely; the first where none is available.
    pub fn any(&mut self, available: &[u8]) -> Action {
        let count = available.iter().filter(|&&flag| flag != 0).count();
        if count == 0 {
            return 0;
        }
        let choice = self.rng.random_range(0..count);
        let mut allowed = available.iter().enumerate().filter(|(_, flag)| **flag != 0);
        allowed.nth(choice).map_or(0, |(action, _)| action as Action)
    }

    fn persists(&mut self) -> bool {
        // Nothing is drawn where nothing depends on it: such streams are those of the paper's exploration.
        self.persistence > 0.0 && self.rng.random::<f32>() < self.persistence
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{RunSeed, Stream};

    const STEPS: usize = 10_000;

    /// What one agent does on each of many steps with two of three actions available.
    fn actions(epsilon: f32, persistence: f32) -> Vec<Option<Action>> {
        let rng = RunSeed(0).stream(Stream::Exploration, 0);
        let mut exploration = Exploration::new(epsilon, persistence, 1, rng);
        (0..STEPS).map(|_| exploration.explore(0, &[1, 0, 1])).collect()
    }

    /// How many of `STEPS` there are, give or take five standard deviations.
    #[track_caller]
    fn assert_share(count: usize, probability: f64) {
        let n = STEPS as f64;
        let deviation = (count as f64 - n * probability).abs();
        assert!(deviation < 5.0 * (n * probability * (1.0 - probability)).sqrt(), "{count}, {probability}");
    }

    #[test]
    fn explores_as_often_as_it_should_and_evenly_over_what_is_available() {
        let actions = actions(0.3, 0.0);
        let count = |which| actions.iter().filter(|&&action| action == which).count();
        assert_share(count(None), 0.7);
        assert_share(count(Some(0)), 0.15);
        assert_share(count(Some(2)), 0.15);
        assert_eq!(count(Some(1)), 0);
    }

    #[test]
    fn numbers_to_sample_by_come_where_actions_are_sampled() {
        let rng = || RunSeed(0).stream(Stream::Exploration, 0);
        let mut sampling = Exploration::sampling(rng());
        let mut count = 0;
        for _ in 0..STEPS {
            let u = sampling.sample().unwrap();
            assert!((0.0..1.0).contains(&u));
            count += usize::from(u < 0.3);
        }
        assert_share(count, 0.3);
        let mut greedy = Exploration::new(0.0, 0.0, 1, rng());
        assert_eq!(greedy.sample(), None);
        // Nothing was drawn for it.
        assert_eq!(greedy.rng, rng());
    }

    #[test]
    fn a_policy_draws_only_while_it_explores() {
        let of = |epsilon| Exploration::new(epsilon, 0.0, 1, RunSeed(0).stream(Stream::Exploration, 0));
        assert!(of(0.0).stream().is_none());
        let (mut one, mut other) = (of(0.05), of(1.0));
        assert_eq!(one.stream().map(rand::Rng::next_u64), other.stream().map(rand::Rng::next_u64));
    }

    #[test]
    fn persistence_repeats_the_last_random_action() {
        let repeated = |persistence| {
            let actions = actions(1.0, persistence);
            actions.windows(2).filter(|pair| pair[0] == pair[1]).count()
        };
        assert_share(repeated(0.0), 0.5);
        assert_share(repeated(0.8), 0.9);
        assert_eq!(repeated(1.0), STEPS - 1);
    }

    #[test]
    fn what_is_not_available_any_more_is_not_repeated() {
        let rng = RunSeed(0).stream(Stream::Exploration, 0);
        let mut exploration = Exploration::new(1.0, 1.0, 1, rng);
        assert_eq!(exploration.explore(0, &[0, 1, 0]), Some(1));
        assert_eq!(exploration.explore(0, &[1, 0, 0]), Some(0));
    }
}
