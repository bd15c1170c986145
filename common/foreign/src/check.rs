//! Whether an environment keeps its promises: random episodes in workers, and what is wrong in words.

use rand::RngExt as _;
use rit_env::{Environment, EnvironmentError, EnvironmentFactory, Spec, Task};
use rit_episode::{Action, Observation, Rng, RunSeed, Stream};
use std::time::{Duration, Instant};

/// The same seed for every check, so that what is found is found again.
const SEED: RunSeed = RunSeed(99);

/// A promise that a task's environment breaks.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("task {task}, episode {episode}, after {steps} steps: {what}")]
pub struct Broken {
    /// The task.
    pub task: String,
    /// Which episode, from 0.
    pub episode: u64,
    /// Steps of it that went well.
    pub steps: usize,
    /// What is wrong.
    pub what: String,
    /// Where in the environment's own code, if it raised an error there.
    pub traceback: Option<String>,
}

/// What was seen of a task that keeps its promises.
#[derive(Clone, Debug, PartialEq)]
pub struct Checked {
    /// The task.
    pub task: String,
    /// What it says of itself.
    pub spec: Spec,
    /// Steps of all different episodes.
    pub steps: usize,
    /// Mean return of random actions.
    pub mean_return: f64,
    /// Whether a seed and actions make the same episode: in one environment again, and in another.
    pub is_reproducible: bool,
    /// Time that all of it took.
    pub duration: Duration,
}

/// An episode that was rolled: every state, and the reward that led to it.
type Course = Vec<(Observation, f32)>;

/// Rolls so many episodes of random actions of a task, each twice in one environment and once in another.
///
/// # Errors
/// The first promise that is broken.
pub fn check(worlds: &dyn EnvironmentFactory, task: Task, episodes: u64) -> Result<Checked, Broken> {
    let begun = Instant::now();
    let broken = |episode, (steps, fault): (usize, Fault)| {
        let Fault { what, traceback } = fault;
        Broken { task: task.to_string(), episode, steps, what, traceback }
    };
    let build = || worlds.build(task).map_err(|error| broken(0, (0, error.into())));
    let (mut first, mut second) = (build()?, build()?);
    let (mut steps, mut total, mut is_reproducible) = (0, 0.0, true);
    for episode in 0..episodes {
        let course = roll(first.as_mut(), episode).map_err(|what| broken(episode, what))?;
        for world in [&mut first, &mut second] {
            let again = roll(world.as_mut(), episode).map_err(|what| broken(episode, what))?;
            is_reproducible &= course == again;
        }
        steps += course.len() - 1;
        total += course.iter().map(|(_, reward)| f64::from(*reward)).sum::<f64>();
    }
    Ok(Checked {
        task: task.to_string(),
        spec: worlds.spec(task),
        steps,
        mean_return: total / episodes.max(1) as f64,
        is_reproducible,
        duration: begun.elapsed(),
    })
}

/// What is wrong, and where in the environment's code.
struct Fault {
    what: String,
    traceback: Option<String>,
}

impl From<EnvironmentError> for Fault {
    fn from(EnvironmentError { kind, detail, traceback }: EnvironmentError) -> Self {
        let kind = kind.name().trim_start_matches("environment_").replace('_', " ");
        Self { what: format!("{kind}: {detail}"), traceback }
    }
}

/// One episode of random available actions; or after how many steps something was wrong, and what.
fn roll(world: &mut dyn Environment, episode: u64) -> Result<Course, (usize, Fault)> {
    let rng = &mut SEED.stream(Stream::Environment, episode);
    let exploration = &mut SEED.stream(Stream::Exploration, episode);
    let spec = world.spec();
    world.begin_reset(rng).and_then(|()| world.reset(rng)).map_err(|error| (0, error.into()))?;
    let mut course = Course::new();
    let mut reward = 0.0;
    let mut is_over = false;
    loop {
        let mut observation =
            Observation::new(spec.n_agents, spec.n_entities, spec.feature_dim, spec.n_actions);
        world.observe(&mut observation);
        course.push((observation, reward));
        let steps = course.len() - 1;
        if is_over {
            return Ok(course);
        }
        if steps >= spec.steps_max {
            let what = format!("the episode does not end within steps_max = {}", spec.steps_max);
            return Err((steps, Fault { what, traceback: None }));
        }
        let (seen, _) = &course[steps];
        let actions: Vec<Action> = (0..spec.n_agents).map(|agent| any(seen, agent, exploration)).collect();
        let stepped = world.begin_step(&actions).and_then(|()| world.step(&actions, rng));
        let step = stepped.map_err(|error| (steps, error.into()))?;
        (reward, is_over) = (step.reward, step.end.is_some());
    }
}

fn any(seen: &Observation, agent: usize, rng: &mut Rng) -> Action {
    let available = seen.available_to(agent);
    let actions: Vec<Action> =
        (0..available.len()).filter(|&at| available[at] == 1).map(|at| at as Action).collect();
    actions[rng.random_range(0..actions.len())]
}
