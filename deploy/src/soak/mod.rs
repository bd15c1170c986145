//! `rit soak`: trains a run while its processes are killed, stopped and told to end again and again, while others are
//! started for it and copies of it go on, and holds its end to that of the same run left in peace. Nothing may be lost, nothing may come twice, and the weights must be the same to the last bit.

mod fire;
mod schedule;
mod simulated;

use crate::{cli::SoakOptions, experiments, failure::Failure, output, shutdown};
use fire::{Dealt, Run};
use rit_config::RunDir;
use rit_episode::{Episode, wire::Expected};
use rit_learner::replay_log;
use rit_record::Summary;
use schedule::Blow;
use serde::Serialize;
use std::{collections::BTreeMap, fs, path::Path, process::ExitCode};

/// What a soak came to.
#[derive(Debug, Serialize)]
struct Report {
    kills: usize,
    by_blow: BTreeMap<Blow, Times>,
    /// Copies that were resumed beside the run, all of which ended as the run itself.
    copies: usize,
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

/// From a blow to the moment that all is well again: the learner answers and counts the victim's successor.
#[derive(Debug, Default, Serialize)]
struct Times {
    kills: usize,
    mean_recovery_s: f64,
    max_recovery_s: f64,
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
    // Among the blows are hang-ups.
    shutdown::hand_hangups_down();
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
            // The soak goes on for its end, with or without a reader.
            let _ = output::say(words);
        }
    };
    say(&format!("{}: once undisturbed", options.experiment));
    let undisturbed = Run::start(&options.experiment, &settings, &folder.join("undisturbed"))?;
    let expected = undisturbed.finish().await?.swap_remove(0);

    say(&format!("and once with {} kills", options.kills));
    settings.push(format!("checkpoints.every_env_steps={every}"));
    let mut run = Run::start(&options.experiment, &settings, &folder.join("disturbed"))?;
    let schedule = schedule::draw(options.seed, options.kills, config.training.t_max);
    let kills = run.under_fire(&schedule, &say).await?;
    let ledger_checks = run.ledger_checks();
    let ended = run.finish().await?;

    let report = compare(folder, &kills, ledger_checks, &expected, &ended)?;
    output::print(&if options.json {
        serde_json::to_string_pretty(&report).map_err(Failure::runtime)? + "\n"
    } else {
        table(&report)
    })?;
    Ok(if report.same { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn compare(
    folder: &Path,
    kills: &[Dealt],
    ledger_checks: u64,
    expected: &Summary,
    ended: &[Summary],
) -> Result<Report, Failure> {
    let (undisturbed, disturbed) = (replay(&folder.join("undisturbed"))?, replay(&folder.join("disturbed"))?);
    let count = |summary: &Summary| summary.progress.episodes;
    let digest = |summary: &Summary| summary.weights_digest.clone().unwrap_or_default();
    let found = &ended[0];
    // All that does not depend on time.
    fn facts(it: &Summary) -> impl PartialEq + '_ {
        (&it.weights_digest, it.progress, &it.evaluation, &it.testing, &it.best)
    }
    let same_summary = ended.iter().all(|summary| facts(summary) == facts(expected));
    let mut by_blow: BTreeMap<Blow, Times> = BTreeMap::new();
    for Dealt { blow, recovery_s } in kills {
        let times = by_blow.entry(*blow).or_default();
        times.kills += 1;
        times.mean_recovery_s += (recovery_s - times.mean_recovery_s) / times.kills as f64;
        times.max_recovery_s = times.max_recovery_s.max(*recovery_s);
    }
    Ok(Report {
        kills: kills.len(),
        by_blow,
        copies: ended.len().saturating_sub(1),
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
    let end = summary(&run_dir)?.progress.episodes;
    let numbers = end.saturating_sub(config.algorithm.buffer_size as u64)..end;
    let expected = Expected { run_id: run_dir.lineage(), ..rit_learner::expected(&run_dir, &config) };
    replay_log::read(&run_dir.replay(), &expected, numbers).map_err(Failure::runtime)
}

/// What a run that has ended came to.
fn summary(run_dir: &RunDir) -> Result<Summary, Failure> {
    let summary = Summary::read(run_dir).map_err(Failure::runtime)?;
    let missing = || Failure::runtime_message(format!("{} is missing", run_dir.summary().display()));
    summary.ok_or_else(missing)
}

fn table(report: &Report) -> String {
    let mut text = format!("{:<38}{:>6}{:>16}{:>16}\n", "what was done", "times", "mean recovery", "longest");
    for (blow, times) in &report.by_blow {
        let Times { kills, mean_recovery_s, max_recovery_s } = times;
        text += &format!("{:<38}{kills:>6}{mean_recovery_s:>14.2} s{max_recovery_s:>14.2} s\n", blow.words());
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
