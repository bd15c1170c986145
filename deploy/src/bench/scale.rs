//! How costs grow: with agents, with entities, with actors.

use super::{Measured, Report, learner, rollout};
use crate::{child, failure::Failure};
use rit_env::{Task, particle::PredatorPreyReward};
use rustix::param::clock_ticks_per_second;
use serde_json::{Value, json};
use std::{fs, process::Stdio, time::Duration};

/// Agents, or prey, of one task.
const SIZES: [usize; 5] = [2, 4, 8, 16, 32];

/// Batches that replay holds: sampling costs nothing that would be worth more.
const REPLAY_BATCHES: usize = 4;

/// Actor processes of one run.
const ACTORS: [usize; 3] = [1, 2, 4];

/// Environment steps of such a run, for each second that is to be measured.
const STEPS_A_SECOND: f64 = 8_000.0;

/// `agents`: cooperative navigation (n, n), agents and landmarks growing alike. `entities`: two predators, ever
/// more prey. `actors`: whole short runs of the experiment, learner and all.
pub(super) fn run(
    measured: &Measured,
    experiment: &str,
    settings: &[String],
    duration: Duration,
) -> Result<Report, Failure> {
    let hunt = |prey| Task::PredatorPrey { predators: 2, prey, reward: PredatorPreyReward::Plain };
    let share = duration / (2 * SIZES.len() + ACTORS.len()) as u32;
    let grown = |task: fn(usize) -> Task| -> Result<Vec<Value>, Failure> {
        SIZES.iter().map(|&size| costs(measured, task(size), share)).collect()
    };
    let mut report = Report::new();
    report.insert("agents".into(), grown(|n| Task::CooperativeNavigation { n })?.into());
    report.insert("entities".into(), grown(hunt)?.into());
    let runs = ACTORS.iter().map(|&actors| whole_run(experiment, settings, actors, share));
    report.insert("actors".into(), runs.collect::<Result<Vec<Value>, _>>()?.into());
    Ok(report)
}

/// What an update and a step cost on one task.
fn costs(measured: &Measured, task: Task, duration: Duration) -> Result<Value, Failure> {
    let replay_episodes = REPLAY_BATCHES * measured.config.algorithm.batch_size;
    let update = learner::measure(measured, &[task], replay_episodes, duration / 2)?;
    let rolling = rollout::measure(measured, vec![task], duration / 2);
    let (size, count) = (task.size(), f64::from(update.updates));
    Ok(json!({
        "task": task.to_string(),
        "agents": size.n_agents,
        "entities": size.n_entities,
        "update_cpu_ms": 1e3 * update.cpu_s / count,
        "update_gflop": update.flops as f64 / count * 1e-9,
        "gemm_gflop_per_cpu_s": update.flops as f64 / update.cpu_s * 1e-9,
        "rollout_env_steps_per_cpu_s": rolling.env_steps as f64 / rolling.cpu_s,
    }))
}

/// `rit train` from beginning to end, user and system time of all its processes.
fn whole_run(
    experiment: &str,
    settings: &[String],
    actors: usize,
    duration: Duration,
) -> Result<Value, Failure> {
    let folder = tempfile::tempdir().map_err(Failure::runtime)?;
    let steps = (duration.as_secs_f64() * STEPS_A_SECOND).max(STEPS_A_SECOND) as u64;
    let mut command = child::this_program();
    command.args(["train", experiment, "--json", "--run-dir"]).arg(folder.path().join("run"));
    command.args(["--actors", &actors.to_string(), "--steps", &steps.to_string()]);
    command.args(settings.iter().flat_map(|setting| ["--set", setting]));
    let before = children_cpu_s()?;
    let output = command.stderr(Stdio::inherit()).output().map_err(Failure::runtime)?;
    let cpu_s = children_cpu_s()? - before;
    if !output.status.success() {
        return Err(Failure::runtime_message(format!("the run with {actors} actors failed")));
    }
    let summary: Value = serde_json::from_slice(&output.stdout).map_err(Failure::runtime)?;
    let env_steps = summary["env_steps"].as_f64().unwrap_or_default();
    let wall_s = summary["wall_s"].as_f64().unwrap_or_default();
    Ok(json!({
        "actors": actors,
        "env_steps": summary["env_steps"],
        "updates": summary["updates"],
        "env_steps_per_s": env_steps / wall_s,
        "cpu_s": cpu_s,
        "env_steps_per_cpu_s": env_steps / cpu_s,
    }))
}

/// CPU seconds of all children that have ended, their children included: fields 16 and 17 of `proc_pid_stat(5)`.
fn children_cpu_s() -> Result<f64, Failure> {
    let stat = fs::read_to_string("/proc/self/stat").map_err(Failure::runtime)?;
    // The program's name, the second field, may hold anything but ends with the last bracket.
    let fields = stat.rsplit(')').next().unwrap_or_default().split_whitespace();
    let ticks: f64 = fields.skip(13).take(2).filter_map(|field| field.parse::<f64>().ok()).sum();
    Ok(ticks / clock_ticks_per_second() as f64)
}
