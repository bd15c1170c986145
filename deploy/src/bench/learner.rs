//! One learner update, as training makes it.

use super::{Measured, Report, random_episodes, thread_cpu_s};
use crate::failure::Failure;
use rit_algo::{Learner, Regime, learner::Draw};
use rit_env::{Split, Task};
use rit_episode::Stream;
use rit_learner::replay::Replay;
use rit_nn::{Accum, View, ViewMut, matmul};
use rit_record::cpu_seconds;
use std::{
    fs,
    sync::Arc,
    time::{Duration, Instant},
};

/// Side of the large product that stands for this core's limit.
const LARGE: usize = 2048;

/// What one update costs.
pub(super) struct Cost {
    pub updates: u32,
    pub cpu_s: f64,
    pub wall_s: f64,
    pub flops: u64,
    pub parameters: usize,
    pub replay_episodes: usize,
    pub replay_bytes: usize,
}

pub(super) fn run(measured: &Measured, duration: Duration) -> Result<Report, Failure> {
    let config = &measured.config;
    let tasks = config.tasks(Split::Training);
    let limit_before = large_product_flops();
    let cost = measure(measured, &tasks, config.algorithm.buffer_size, duration)?;
    // A shared machine's speed drifts: the limit is measured before and after.
    let limit = f64::midpoint(limit_before, large_product_flops());

    let (count, flops, cpu) = (f64::from(cost.updates), cost.flops as f64, cost.cpu_s);
    let mut report = Report::new();
    report.insert("update_cpu_ms".into(), (1e3 * cpu / count).into());
    report.insert("update_wall_ms".into(), (1e3 * cost.wall_s / count).into());
    report.insert("update_gflop".into(), (flops / count * 1e-9).into());
    report.insert("gemm_gflop_per_cpu_s".into(), (flops / cpu * 1e-9).into());
    report.insert("limit_gflop_per_cpu_s".into(), (limit * 1e-9).into());
    report.insert("gemm_share".into(), (flops / cpu / limit).into());
    report.insert("limit".into(), format!("one thread's {LARGE}³ f32 product, before and after").into());
    report.insert("updates".into(), cost.updates.into());
    report.insert("parameters".into(), cost.parameters.into());
    report.insert("replay_episodes".into(), cost.replay_episodes.into());
    report.insert("replay_mb".into(), (cost.replay_bytes as f64 * 1e-6).into());
    report.insert("peak_rss_mb".into(), peak_rss_mb().into());
    Ok(report)
}

/// Makes updates from a replay of so many episodes of these tasks for so long, three at least.
pub(super) fn measure(
    Measured { config, model, params }: &Measured,
    tasks: &[Task],
    replay_episodes: usize,
    duration: Duration,
) -> Result<Cost, Failure> {
    let learner = model.learner(config.update(), params.clone());
    let mut learner = learner.map_err(Failure::runtime)?;
    let mut replay = Replay::new(replay_episodes);
    let mut replay_bytes = 0;
    for episode in random_episodes(config, tasks, replay_episodes as u64) {
        replay_bytes += episode.bytes();
        replay.insert(Arc::new(episode));
    }

    let mut number = 0;
    // A method that learns from each batch once takes as many episodes as are rolled for an update.
    let batch_size = match learner.regime() {
        Regime::Replay => config.algorithm.batch_size,
        Regime::OnPolicy => config.algorithm.n_rollout_threads,
    };
    let mut one_update = |learner: &mut dyn Learner| {
        let draw = Draw { seed: config.seed, update: number };
        let batch = replay.sample(batch_size, &mut draw.stream(Stream::Replay));
        number += 1;
        learner.learn(&batch, draw).map_err(Failure::runtime)
    };
    for _ in 0..3 {
        one_update(&mut *learner)?;
    }
    let (cpu, wall, flops) = (cpu_seconds(), Instant::now(), matmul::flops());
    let mut updates = 0;
    while wall.elapsed() < duration || updates < 3 {
        one_update(&mut *learner)?;
        updates += 1;
    }
    Ok(Cost {
        updates,
        cpu_s: cpu_seconds() - cpu,
        wall_s: wall.elapsed().as_secs_f64(),
        flops: matmul::flops() - flops,
        parameters: model.layout().len(),
        replay_episodes: replay.len(),
        replay_bytes,
    })
}

/// This core's rate on one large product: multiplications and additions per CPU second.
fn large_product_flops() -> f64 {
    let x = vec![0.5; LARGE * LARGE];
    let mut y = vec![0.0; LARGE * LARGE];
    let mut best = f64::INFINITY;
    for _ in 0..4 {
        let begun = thread_cpu_s();
        let (x, y) = (View::dense(&x, LARGE), ViewMut::dense(&mut y, LARGE));
        matmul::x_wt(x, x, y, Accum::Replace);
        best = best.min(thread_cpu_s() - begun);
    }
    2.0 * (LARGE as f64).powi(3) / best
}

/// The process's largest resident memory, in megabytes; 0 where the system does not say.
fn peak_rss_mb() -> f64 {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kib = line.and_then(|line| line.trim().trim_end_matches(" kB").parse::<f64>().ok());
    kib.unwrap_or(0.0) * 1024e-6
}
