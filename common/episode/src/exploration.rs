//! How the actions of one running episode come about: greedy, ε-greedy, or drawn from the policy's distribution.

use crate::{Action, Rng};
use rand::RngExt as _;

/// How an episode's actions come about.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Choice {
    /// The policy's best, and nothing is drawn: evaluation.
    Greedy,
    /// With this probability, per agent and step, a random action; else the policy's best.
    EpsilonGreedy(f32),
    /// Drawn from the policy's distribution over actions.
    Sampled,
}

/// What chance adds to an episode's actions.
#[derive(Clone, Debug)]
pub struct Exploration {
    choice: Choice,
    /// Probability that a random action is the agent's last random one again.
    persistence: f32,
    /// The episode's own stream.
    rng: Rng,
    /// Each agent's last random action.
    last: Vec<Option<Action>>,
}

impl Exploration {
    /// Of an episode with `n_agents`, from its own stream. `persistence` is a probability; at 0 the random
    /// actions are independent, as in the paper.
    pub fn new(choice: Choice, persistence: f32, n_agents: usize, rng: Rng) -> Self {
        Self { choice, persistence, rng, last: vec![None; n_agents] }
    }

    /// A random action for the agent of this row, if it is to explore on this step; to be asked once a step.
    /// `available` has a flag for each action.
    pub fn explore(&mut self, row: usize, available: &[u8]) -> Option<Action> {
        let Choice::EpsilonGreedy(epsilon) = self.choice else { return None };
        // Drawn for any ε, so that the stream stays in step.
        let explores = self.rng.random::<f32>() < epsilon;
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

    /// A number in 0..1 to choose an action with, by the policy's distribution; to be asked once for each agent and
    /// step, in row order. None where the best action is to be chosen.
    pub fn sample(&mut self) -> Option<f32> {
        (self.choice == Choice::Sampled).then(|| self.rng.random())
    }

    /// The episode's own stream, for a policy's further random numbers in training; none in evaluation.
    pub fn stream(&mut self) -> Option<&mut Rng> {
        (self.choice != Choice::Greedy).then_some(&mut self.rng)
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
        let mut exploration = Exploration::new(Choice::EpsilonGreedy(epsilon), persistence, 1, rng);
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
    fn only_what_is_asked_for_is_drawn() {
        let of = |choice| Exploration::new(choice, 0.0, 1, RunSeed(0).stream(Stream::Exploration, 0));
        let mut greedy = of(Choice::Greedy);
        assert_eq!((greedy.explore(0, &[1]), greedy.sample()), (None, None));
        assert!(greedy.stream().is_none());
        let mut sampled = of(Choice::Sampled);
        assert_eq!(sampled.explore(0, &[1]), None);
        let mut stream = RunSeed(0).stream(Stream::Exploration, 0);
        let expected: [f32; 2] = [stream.random(), stream.random()];
        assert_eq!([sampled.sample(), sampled.sample()], expected.map(Some));
        let mut explores = of(Choice::EpsilonGreedy(1.0));
        assert_eq!((explores.explore(0, &[0, 1]), explores.sample()), (Some(1), None));
        assert!(explores.stream().is_some());
    }

    #[test]
    fn what_is_not_available_any_more_is_not_repeated() {
        let rng = RunSeed(0).stream(Stream::Exploration, 0);
        let mut exploration = Exploration::new(Choice::EpsilonGreedy(1.0), 1.0, 1, rng);
        assert_eq!(exploration.explore(0, &[0, 1, 0]), Some(1));
        assert_eq!(exploration.explore(0, &[1, 0, 0]), Some(0));
    }
}
