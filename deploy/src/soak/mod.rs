//! `rit soak`: trains a run while its processes are killed again and again, and holds its end to that of the same
//! run left in peace. Nothing may be lost, nothing may come twice, and the weights must be the same to the last bit.

mod fire;
mod simulated;

use crate::{cli::SoakOptions, experiments, failure::Failure, output};
use fire::{Kill, Run, Victim};
use rit_config::RunDir;
use rit_episode::{Episode, RunSeed, Stream, wire::Expected};
use rit_learner::replay_log;
use serde::Serialize;
use serde_json::Value;
use std::{collections::BTreeMap, fs, path::Path, process::ExitCode};

/// What a soak came to.
#[derive(Debug, Serialize)]
struct Report {
    kills: usize,
    by_victim: BTreeMap<Victim, Times>,
    /// Looks at the ledger, all of them with `handed_out = inserted + rejected + outstanding`.
    ledger_checks: u64,
    episodes: u64,
    /// Episodes that replay holds at the end, compared one by one.
    episodes_compared: u64,
    lost: u64,
    duplicated: u64,
    weights_digest: String,
    undisturbed_weights_digest: String,
    /// Whether weights, evaluation, counts and replay are those of the undisturbed run.
    same: bool,
}

/// From a kill to the moment the learner counts the victim's successor.
#[derive(Debug, Default, Serialize)]
struct Times {
    kills: usize,
    mean_restart_s: f64,
    max_restart_s: f64,
}

/// `rit soak`.
///
/// # Errors
/// When a run fails; a run that ends otherwise than the undisturbed one is no error here but exit code 1.
pub async fn run(options: SoakOptions) -> Result<ExitCode, Failure> {
    if options.simulated {
        return simulated::run(options.runs, options.seed, options.json);
    }
    let folder = &options.dir;
    if folder.exists() {
        let folder = folder.display();
        return Err(Failure::input_message(format!(
            "{folder} exists; choose another --dir, or move it away"
        )));
    }
    // What is wrong with the experiment is said before anything is made.
    let mut settings = options.settings.clone();
    settings.extend(experiments::algorithm(options.algorithm.as_deref()));
    settings.push(format!("seed={}", options.seed));
    settings.extend(options.steps.map(|steps| format!("training.t_max={steps}")));
    settings.push(format!("actors.count={}", options.actors));
    let config = experiments::load(&options.experiment, &settings)?.config;
    let every = (config.training.t_max / (2 * options.kills as u64 + 1)).max(1);
    if let Some(parent) = folder.parent() {
        fs::create_dir_all(parent).map_err(Failure::runtime)?;
    }
    // Of two that do so at once, one has it.
    fs::create_dir(folder).map_err(Failure::runtime)?;

    let say = |words: &str| {
        if !options.json {
            // The soak goes on for its end, whoever listens meanwhile.
            let _ = output::say(words);
        }
    };
    say(&format!("{}: once undisturbed", options.experiment));
    let undisturbed = Run::start(&options.experiment, &settings, &folder.join("undisturbed"))?;
    let expected = undisturbed.finish().await?;

    say(&format!("and once with {} kills", options.kills));
    settings.push(format!("checkpoints.every_env_steps={every}"));
    let mut run = Run::start(&options.experiment, &settings, &folder.join("disturbed"))?;
    let mut rng = RunSeed(options.seed).derive("soak", 0).stream(Stream::Exploration, 0);
    let kills = run.under_fire(options.kills, config.training.t_max, &mut rng, &say).await?;
    let ledger_checks = run.ledger_checks();
    let found = run.finish().await?;

    let report = compare(folder, &kills, ledger_checks, &expected, &found)?;
    output::print(&if options.json {
        serde_json::to_string_pretty(&report).map_err(Failure::runtime)? + "\n"
    } else {
        table(&report)
    })?;
    Ok(if report.same { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn compare(
    folder: &Path,
    kills: &[Kill],
    ledger_checks: u64,
    expected: &Value,
    found: &Value,
) -> Result<Report, Failure> {
    let (undisturbed, disturbed) = (replay(&folder.join("undisturbed"))?, replay(&folder.join("disturbed"))?);
    let count = |summary: &Value| summary["episodes"].as_u64().unwrap_or_default();
    let digest = |summary: &Value| summary["weights_digest"].as_str().unwrap_or_default().to_owned();
    let same_summary = ["weights_digest", "env_steps", "episodes", "updates", "evaluation"]
        .iter()
        .all(|&key| expected[key] == found[key]);
    let mut by_victim: BTreeMap<Victim, Times> = BTreeMap::new();
    for Kill { victim, restart_s } in kills {
        let times = by_victim.entry(*victim).or_default();
        times.kills += 1;
        times.mean_restart_s += (restart_s - times.mean_restart_s) / times.kills as f64;
        times.max_restart_s = times.max_restart_s.max(*restart_s);
    }
    Ok(Report {
        kills: kills.len(),
        by_victim,
        ledger_checks,
        episodes: count(found),
        episodes_compared: disturbed.len() as u64,
        // The log of replay refuses an episode out of its place, so what is missing or twofold shows in its count.
        lost: count(expected).saturating_sub(count(found)),
        duplicated: count(found).saturating_sub(count(expected)),
        weights_digest: digest(found),
        undisturbed_weights_digest: digest(expected),
        same: same_summary && undisturbed == disturbed,
    })
}

/// The episodes that replay held at the end, each checked as on its way in.
fn replay(root: &Path) -> Result<Vec<Episode>, Failure> {
    let (run_dir, config) = RunDir::open(root)?;
    let summary = fs::read(run_dir.summary()).map_err(Failure::runtime)?;
    let summary: Value = serde_json::from_slice(&summary).map_err(Failure::runtime)?;
    let end = summary["episodes"].as_u64().unwrap_or_default();
    let numbers = end.saturating_sub(config.algorithm.buffer_size as u64)..end;
    let expected = Expected { run_id: run_dir.lineage(), ..rit_learner::expected(&run_dir, &config) };
    replay_log::read(&run_dir.replay(), &expected, numbers).map_err(Failure::runtime)
}

fn table(report: &Report) -> String {
    let mut text = format!("{:<34}{:>6}{:>16}{:>16}\n", "killed", "kills", "mean restart", "longest restart");
    for (victim, times) in &report.by_victim {
        let Times { kills, mean_restart_s, max_restart_s } = times;
        text += &format!("{:<34}{kills:>6}{mean_restart_s:>14.2} s{max_restart_s:>14.2} s\n", victim.words());
    }
    let Report { ledger_checks, episodes, episodes_compared, lost, duplicated, .. } = report;
    text += &format!(
        "episodes {episodes}: {lost} lost, {duplicated} duplicated; {episodes_compared} in replay compared; ledger \
         sound at {ledger_checks} looks\n"
    );
    text += &format!("weights digest {}\n", report.weights_digest);
    text += if report.same {
        "the same as undisturbed, to the last bit\n"
    } else {
        "NOT the same as undisturbed; both runs are kept in the --dir folder\n"
    };
    text
}
