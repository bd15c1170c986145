//! Environments alone: random joint actions, step and observe, task by task.

use super::{Report, thread_cpu_s};
use rand::Rng as _;
use rit_config::Config;
use rit_env::Split;
use rit_episode::{Action, Observation, RunSeed, Stream};
use std::time::Duration;

/// Steps from one look at the clock to the next.
const STEPS_A_LOOK: u64 = 10_000;

pub(super) fn run(config: &Config, duration: Duration) -> Report {
    let tasks = config.environment.task_set.tasks(Split::Training);
    let mut report = Report::new();
    let mut rates = Vec::new();
    for task in &tasks {
        let mut environment = task.environment(config.environment_options());
        let rng = &mut RunSeed(1).stream(Stream::Environment, 0);
        let n_actions = environment.n_actions() as u64;
        let mut observation = Observation::default();
        let mut actions: Vec<Action> = vec![0; environment.n_agents()];
        // Cheap and uniform enough: what is measured is the environment.
        let mut state = rng.next_u64() | 1;
        environment.reset(rng);
        let (mut steps, begun) = (0, thread_cpu_s());
        let share = duration.as_secs_f64() / tasks.len() as f64;
        while thread_cpu_s() - begun < share {
            for _ in 0..STEPS_A_LOOK {
                for action in &mut actions {
                    state ^= state << 13;
                    state ^= state >> 7;
                    state ^= state << 17;
                    *action = (state % n_actions) as Action;
                }
                let step = environment.step(&actions, rng);
                let (n, m) = (environment.n_agents(), environment.n_entities());
                observation.reset(n, m, environment.feature_dim(), environment.n_actions());
                environment.observe(&mut observation);
                if step.end.is_some() {
                    environment.reset(rng);
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
    report
}
