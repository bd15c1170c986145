//! Rolling episodes as an actor does: environments, acting networks, recording. No transport.

use super::{Measured, Report};
use crate::failure::Failure;
use rit_algo::Acting;
use rit_config::Config;
use rit_env::{
    Split, Task,
    rollout::{Job, Rollout},
};
use rit_nn::matmul;
use rit_record::cpu_seconds;
use std::time::{Duration, Instant};

/// What rolling costs.
pub(super) struct Cost {
    pub env_steps: u64,
    pub cpu_s: f64,
    pub flops: u64,
}

pub(super) fn run(measured: &Measured, duration: Duration) -> Result<Report, Failure> {
    let config = &measured.config;
    let Cost { env_steps, cpu_s, flops } = measure(measured, config.tasks(Split::Training), duration);
    let mut report = Report::new();
    report.insert("env_steps_per_cpu_s".into(), (env_steps as f64 / cpu_s).into());
    report.insert("gemm_gflop_per_cpu_s".into(), (flops as f64 / cpu_s * 1e-9).into());
    report.insert("env_steps".into(), env_steps.into());
    report.insert("episodes_side_by_side".into(), side_by_side(config).into());
    Ok(report)
}

fn side_by_side(config: &Config) -> u64 {
    config.actors.episodes_at_once.min(config.algorithm.n_rollout_threads) as u64
}

/// Rolls episodes of these tasks for so long.
pub(super) fn measure(
    Measured { config, model, params }: &Measured,
    tasks: Vec<Task>,
    duration: Duration,
) -> Cost {
    let mut acting = Acting::new(model, &params[model.acting()]);
    let factory = rit_worlds::factory(config);
    let mut rollout = Rollout::new(tasks, factory, config.seed, config.algorithm.random_permutation);
    let side_by_side = side_by_side(config);
    let choice = model.method().exploring(0.05);
    let mut number = 0;
    let mut roll = |acting: &mut Acting| -> u64 {
        let jobs: Vec<Job> = (number..number + side_by_side)
            .map(|number| Job { number, weights_version: 0, choice, task: None })
            .collect();
        number += side_by_side;
        rollout.roll(acting, &jobs).iter().flatten().map(|episode| episode.steps() as u64).sum()
    };
    roll(&mut acting);
    let (cpu, wall, flops) = (cpu_seconds(), Instant::now(), matmul::flops());
    let mut env_steps = 0;
    while wall.elapsed() < duration {
        env_steps += roll(&mut acting);
    }
    Cost { env_steps, cpu_s: cpu_seconds() - cpu, flops: matmul::flops() - flops }
}
