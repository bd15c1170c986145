//! Embedded environments alone: random joint actions, step and observe, task by task.

use super::{Report, thread_cpu_s};
use crate::failure::Failure;
use rand::Rng as _;
use rit_config::Config;
use rit_env::{Environment, Split};
use rit_episode::{Action, Observation, RunSeed, Stream};
use std::time::Duration;

/// Steps from one look at the clock to the next.
const STEPS_A_LOOK: u64 = 10_000;

pub(super) fn run(config: &Config, duration: Duration) -> Result<Report, Failure> {
    let tasks = config.tasks(Split::Training);
    let mut report = Report::new();
    let mut rates = Vec::new();
    for task in &tasks {
        let mut environment = task.environment(config.environment_options());
        let rng = &mut RunSeed(1).stream(Stream::Environment, 0);
        let spec = task.spec();
        let mut observation = Observation::default();
        let mut actions: Vec<Action> = vec![0; spec.n_agents];
        // Cheap and uniform enough: what is measured is the environment.
        let mut state = rng.next_u64() | 1;
        let observe = |environment: &dyn Environment, observation: &mut Observation| {
            observation.reset(spec.n_agents, spec.n_entities, spec.feature_dim, spec.n_actions);
            environment.observe(observation);
        };
        environment.reset(rng).map_err(Failure::runtime)?;
        observe(environment.as_ref(), &mut observation);
        let (mut steps, begun) = (0, thread_cpu_s());
        let share = duration.as_secs_f64() / tasks.len() as f64;
        while thread_cpu_s() - begun < share {
            for _ in 0..STEPS_A_LOOK {
                for (agent, action) in actions.iter_mut().enumerate() {
                    state ^= state << 13;
                    state ^= state >> 7;
                    state ^= state << 17;
                    let drawn = (state % spec.n_actions as u64) as usize;
                    let mut in_turn = (drawn..spec.n_actions).chain(0..drawn);
                    let available = observation.available_to(agent);
                    *action = in_turn.find(|&action| available[action] == 1).unwrap_or_default() as Action;
                }
                let step = environment.step(&actions, rng).map_err(Failure::runtime)?;
                observe(environment.as_ref(), &mut observation);
                if step.end.is_some() {
                    environment.reset(rng).map_err(Failure::runtime)?;
                    observe(environment.as_ref(), &mut observation);
                }
            }
            steps += STEPS_A_LOOK;
        }
        let rate = steps as f64 / (thread_cpu_s() - begun);
        report.insert(format!("{task}_env_steps_per_cpu_s"), rate.into());
        rates.push(rate);
    }
    // Tasks come equally often: the mean time of a step counts.
    let mean = rates.len() as f64 / rates.iter().map(|rate| 1.0 / rate).sum::<f64>();
    report.insert("env_steps_per_cpu_s".into(), mean.into());
    Ok(report)
}
