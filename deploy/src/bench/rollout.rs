//! Rolling episodes as an actor does: environments, acting networks, recording. No transport.

use super::{Report, cpu_s};
use crate::failure::Failure;
use rit_algo::{Acting, Rit};
use rit_config::Config;
use rit_env::{
    Split,
    rollout::{Job, Rollout},
};
use rit_episode::Stream;
use rit_nn::matmul;
use std::{
    sync::Arc,
    time::{Duration, Instant},
};

pub(super) fn run(config: &Config, duration: Duration) -> Result<Report, Failure> {
    let rit = Arc::new(Rit::new(config.rit()).map_err(Failure::input)?);
    let params = rit.layout.initial(&mut config.seed.stream(Stream::Weights, 0));
    let mut acting = Acting::new(Arc::clone(&rit), &params[rit.acting()]);
    let tasks = config.environment.task_set.tasks(Split::Training);
    let mut rollout =
        Rollout::new(tasks, config.environment_options(), config.seed, config.algorithm.random_permutation);
    let side_by_side = config.actors.episodes_at_once.min(config.algorithm.n_rollout_threads) as u64;
    let mut number = 0;
    let mut roll = |acting: &mut Acting| -> u64 {
        let jobs: Vec<Job> = (number..number + side_by_side)
            .map(|number| Job { number, weights_version: 0, epsilon: 0.05, task: None })
            .collect();
        number += side_by_side;
        rollout.roll(acting, &jobs).iter().map(|episode| episode.steps() as u64).sum()
    };
    roll(&mut acting);
    let (cpu, wall, flops) = (cpu_s(), Instant::now(), matmul::flops());
    let mut env_steps = 0;
    while wall.elapsed() < duration {
        env_steps += roll(&mut acting);
    }
    let (cpu, flops) = (cpu_s() - cpu, matmul::flops() - flops);
    let mut report = Report::new();
    report.insert("env_steps_per_cpu_s".into(), (env_steps as f64 / cpu).into());
    report.insert("gemm_gflop_per_cpu_s".into(), (flops as f64 / cpu * 1e-9).into());
    report.insert("env_steps".into(), env_steps.into());
    report.insert("episodes_side_by_side".into(), side_by_side.into());
    Ok(report)
}
