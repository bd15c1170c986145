//! An environment seen in decision order.

use crate::{Environment, EnvironmentError, Spec, Step};
use rit_episode::{Action, Observation, Rng, Seating, decision_order};

/// An environment whose agents sit in decision order: see [`Seating`].
pub struct Seated {
    environment: Box<dyn Environment>,
    spec: Spec,
    seating: Seating,
    /// The environment's own view, agents in its own order.
    inner: Observation,
}

impl Seated {
    /// Takes an environment; [`Seated::reset`] comes before anything else.
    pub fn new(environment: Box<dyn Environment>) -> Self {
        let spec = environment.spec();
        let mut seating = Seating::default();
        seating.begin(decision_order::identity(spec.n_agents));
        Self { environment, spec, seating, inner: Observation::default() }
    }

    /// What the environment's task is.
    pub fn spec(&self) -> &Spec {
        &self.spec
    }

    /// The environment itself.
    pub fn environment(&self) -> &dyn Environment {
        self.environment.as_ref()
    }

    /// Tells the environment that an episode in this decision order will begin; [`Self::reset`] follows.
    ///
    /// # Errors
    /// When the environment cannot be told.
    ///
    /// # Panics
    /// When the order is not a permutation of the environment's agents.
    pub fn begin_reset(&mut self, order: Vec<u8>, rng: &mut Rng) -> Result<(), EnvironmentError> {
        assert_eq!(order.len(), self.spec.n_agents, "one place for each agent");
        self.seating.begin(order);
        self.environment.begin_reset(rng)
    }

    /// Begins the episode.
    ///
    /// # Errors
    /// When it did not begin.
    pub fn reset(&mut self, rng: &mut Rng) -> Result<(), EnvironmentError> {
        self.environment.reset(rng)
    }

    /// The state with agents in decision order.
    pub fn observe(&mut self, observation: &mut Observation) {
        let Spec { n_agents: n, n_entities: m, feature_dim: features, n_actions, .. } = self.spec;
        self.inner.reset(n, m, features, n_actions);
        self.environment.observe(&mut self.inner);
        self.seating.seat(&self.inner, observation);
    }

    /// Tells the environment a joint action in decision order; [`Self::step`] follows.
    ///
    /// # Errors
    /// When the environment cannot be told.
    pub fn begin_step(&mut self, actions: &[Action]) -> Result<(), EnvironmentError> {
        self.seating.take(actions);
        self.environment.begin_step(self.seating.last_actions())
    }

    /// What the joint action told last leads to.
    ///
    /// # Errors
    /// When the environment cannot go on.
    pub fn step(&mut self, rng: &mut Rng) -> Result<Step, EnvironmentError> {
        self.environment.step(self.seating.last_actions(), rng)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_episode::{RunSeed, Stream};

    /// Three agents and one more entity. Every number says where it belongs: 10 · agent + entity, or + action.
    struct Labelled;

    impl Environment for Labelled {
        fn spec(&self) -> Spec {
            Spec {
                n_agents: 3,
                n_entities: 4,
                feature_dim: 1,
                n_actions: 2,
                steps_max: 1,
                has_wins: false,
                has_scenes: false,
                is_reproducible: true,
            }
        }

        fn reset(&mut self, _: &mut Rng) -> Result<(), EnvironmentError> {
            Ok(())
        }

        fn observe(&self, observation: &mut Observation) {
            for entity in 0..4 {
                observation.entity_mut(entity)[0] = f32::from(entity as u8);
            }
            for agent in 0..3 {
                let label = |at: usize| (10 * agent + at) as u8;
                observation.observable_mut(agent).copy_from_slice(&[0, 1, 2, 3].map(label));
                observation.available_mut(agent).copy_from_slice(&[0, 1].map(label));
            }
        }

        fn step(&mut self, actions: &[Action], _: &mut Rng) -> Result<Step, EnvironmentError> {
            // What it was told, agent 0's action first.
            let told = actions.iter().fold(0.0, |told, &action| 10.0 * told + f32::from(action));
            Ok(Step { reward: told, shaping: 0.0, end: None, won: false })
        }
    }

    #[test]
    fn the_decision_order_reorders_every_axis_of_agents_and_actions_go_back() {
        let mut rng = RunSeed(0).stream(Stream::Environment, 0);
        let (mut seated, mut seen) = (Seated::new(Box::new(Labelled)), Observation::default());
        // Agent 2 decides first, then 0, then 1.
        seated.begin_reset(vec![2, 0, 1], &mut rng).unwrap();
        seated.reset(&mut rng).unwrap();
        seated.observe(&mut seen);
        // Feature, last action.
        assert_eq!(seen.entities(), [2., 0., 0., 0., 0., 0., 1., 0., 0., 3., 0., 0.]);
        assert_eq!(seen.observable(), [22, 20, 21, 23, 2, 0, 1, 3, 12, 10, 11, 13]);
        assert_eq!(seen.available(), [20, 21, 0, 1, 10, 11]);

        // The first to decide, agent 2, takes action 1, agent 0 action 0, agent 1 action 1.
        let mut told = |actions: &[Action]| {
            seated.begin_step(actions).unwrap();
            seated.step(&mut rng).unwrap().reward
        };
        assert_eq!(told(&[1, 0, 1]), 11.0);
        assert_eq!(told(&[0, 0, 1]), 10.0);
        seated.observe(&mut seen);
        assert_eq!(seen.entities(), [2., 1., 0., 0., 1., 0., 1., 0., 1., 3., 0., 0.]);
    }
}
