//! The suite every environment passes. Test code of any crate may run it against an environment of its own.

use crate::{Environment, Spec, Step};
use rand::RngExt as _;
use rit_episode::{Action, Observation, Rng, RunSeed, Stream};

/// Episodes rolled per check.
const EPISODES: u64 = 40;

/// Rolls episodes of random available actions and checks what every environment promises: constant sizes,
/// finite features and rewards, flags that are 0 or 1, an available action for everyone, agents that see
/// themselves or nothing, a scene of every entity or none, an end within the limit, and, where the task is reproducible,
/// the same course from the same stream.
///
/// # Panics
/// With the promise that was broken.
pub fn check(make: impl Fn() -> Box<dyn Environment>) {
    let mut environment = make();
    let again = if environment.spec().is_reproducible { EPISODES } else { 0 };
    for episode in 0..again {
        let once = roll(environment.as_mut(), episode);
        let again = roll(environment.as_mut(), episode);
        assert!(once == again, "reset forgets the episode before");
        assert!(once == roll(make().as_mut(), episode), "the same stream gives the same course");
    }
    let courses: Vec<_> = (0..EPISODES).map(|episode| roll(environment.as_mut(), episode)).collect();
    assert!(courses.iter().any(|course| course != &courses[0]), "actions or randomness change the course");
}

/// One episode's course: every observation and every step.
#[allow(clippy::expect_used, reason = "a suite of assertions")]
fn roll(environment: &mut dyn Environment, episode: u64) -> Vec<(Observation, Option<Step>)> {
    let seed = RunSeed(99);
    let rng = &mut seed.stream(Stream::Environment, episode);
    let exploration = &mut seed.stream(Stream::Exploration, episode);
    let spec = environment.spec();
    let Spec { n_agents: n, n_entities: m, feature_dim: features, n_actions, .. } = spec;
    assert_eq!(spec.check(), Ok(()), "there is something to decide");

    environment.begin_reset(rng).expect("an episode begins");
    environment.reset(rng).expect("an episode begins");
    let mut course: Vec<(Observation, Option<Step>)> = Vec::new();
    loop {
        let mut observation = Observation::new(n, m, features, n_actions);
        environment.observe(&mut observation);
        assert_eq!(observation.check(), Ok(()), "a state is one that may be");
        assert_eq!(environment.spec(), spec, "what a task is does not change");
        assert!(
            environment.scene().map(|scene| scene.bodies.len()) == spec.has_scenes.then_some(m),
            "a scene shows every entity, where there are scenes"
        );
        if course.last().and_then(|(_, step)| *step).is_some_and(|step| step.end.is_some()) {
            course.push((observation, None));
            return course;
        }
        assert!(course.len() < spec.steps_max, "an episode ends within its limit");
        let actions: Vec<Action> =
            (0..n).map(|agent| any_available(&observation, agent, exploration)).collect();
        environment.begin_step(&actions).expect("a legal joint action is taken");
        let step = environment.step(&actions, rng).expect("a legal joint action is taken");
        assert!(step.reward.is_finite() && step.shaping.is_finite(), "rewards are finite");
        course.push((observation, Some(step)));
    }
}

fn any_available(observation: &Observation, agent: usize, rng: &mut Rng) -> Action {
    loop {
        let action = rng.random_range(0..observation.n_actions()) as Action;
        if observation.allows(agent, action) {
            return action;
        }
    }
}
