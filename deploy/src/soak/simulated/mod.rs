//! `rit soak --simulated`: the supervisor, the coordinator and the ledger of the product, in a world that a seed makes.
//! Processes, links, disk and clock are models; who decides what happens next is the real code. A scenario is a fact of
//! its seed, and takes a fraction of a millisecond.

mod actor;
mod children;
mod faults;
mod learner;
mod suffering;
#[cfg(test)]
mod tests;
mod world;

use crate::{experiments, failure::Failure, output};
use rit_config::Config;
use serde::Serialize;
use std::{
    process::ExitCode,
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    thread,
    time::Instant,
};
use world::{Real, World};

/// Failing scenarios that a report names.
const FAILURES_SHOWN: usize = 10;

/// Steps of a failing scenario that are shown, from its end.
const COURSE_SHOWN: usize = 60;

/// What a scenario came to.
#[derive(Clone, Debug, Default)]
struct Tally {
    events: u64,
    /// Processes that died, whatever of.
    deaths: u64,
    /// Lives of learners that went on from a checkpoint.
    resumed: u64,
    /// Episodes trained on, those trained on again after a checkpoint included.
    trained: u64,
}

/// A scenario that broke a promise.
#[derive(Clone, Debug, Serialize)]
struct Broken {
    seed: u64,
    what: String,
    /// Shows it again.
    command: String,
}

/// What all scenarios came to.
#[derive(Debug, Serialize)]
struct Report {
    scenarios: u64,
    first_seed: u64,
    threads: usize,
    seconds: f64,
    scenarios_per_s: f64,
    events: u64,
    deaths: u64,
    learners_resumed: u64,
    episodes_trained: u64,
    broken: u64,
    /// The first of them.
    failures: Vec<Broken>,
}

/// What the threads share.
#[derive(Default)]
struct Shared {
    next: AtomicU64,
    tally: Mutex<Tally>,
    failures: Mutex<Vec<Broken>>,
    broken: AtomicU64,
}

/// Runs scenarios `seed`, `seed + 1`, … on all cores.
///
/// # Errors
/// When the system refuses threads; a broken promise is no error here but exit code 1.
pub fn run(runs: u64, seed: u64, json: bool) -> Result<ExitCode, Failure> {
    let config = experiments::load("matrix-game", &[])?.config;
    let report = simulate(&config, runs, seed);
    let text = if json {
        serde_json::to_string_pretty(&report).map_err(Failure::runtime)? + "\n"
    } else {
        let course = report.failures.first().map(|first| last_steps(&config, first.seed)).unwrap_or_default();
        in_words(&report) + &course
    };
    output::print(&text)?;
    Ok(if report.broken == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn simulate(config: &Config, runs: u64, seed: u64) -> Report {
    let begun = Instant::now();
    let threads = thread::available_parallelism().map_or(1, usize::from);
    let shared = Shared::default();
    thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| work(config, runs, seed, &shared));
        }
    });
    let tally = shared.tally.into_inner().unwrap_or_else(PoisonError::into_inner);
    let mut failures = shared.failures.into_inner().unwrap_or_else(PoisonError::into_inner);
    failures.sort_by_key(|broken| broken.seed);
    failures.truncate(FAILURES_SHOWN);
    let seconds = begun.elapsed().as_secs_f64();
    Report {
        scenarios: runs,
        first_seed: seed,
        threads,
        seconds,
        scenarios_per_s: runs as f64 / seconds,
        events: tally.events,
        deaths: tally.deaths,
        learners_resumed: tally.resumed,
        episodes_trained: tally.trained,
        broken: shared.broken.into_inner(),
        failures,
    }
}

fn work(config: &Config, runs: u64, seed: u64, shared: &Shared) {
    let mut sum = Tally::default();
    loop {
        let index = shared.next.fetch_add(1, Ordering::Relaxed);
        if index >= runs {
            break;
        }
        let seed = seed.wrapping_add(index);
        let (tally, broken) = World::<Real>::new(config, seed).run();
        sum.events += tally.events;
        sum.deaths += tally.deaths;
        sum.resumed += tally.resumed;
        sum.trained += tally.trained;
        if let Some(what) = broken {
            shared.broken.fetch_add(1, Ordering::Relaxed);
            let command = format!("rit soak --simulated --runs 1 --seed {seed}");
            let mut failures = shared.failures.lock().unwrap_or_else(PoisonError::into_inner);
            failures.push(Broken { seed, what, command });
        }
    }
    let mut tally = shared.tally.lock().unwrap_or_else(PoisonError::into_inner);
    tally.events += sum.events;
    tally.deaths += sum.deaths;
    tally.resumed += sum.resumed;
    tally.trained += sum.trained;
}

/// How a scenario ends.
fn last_steps(config: &Config, seed: u64) -> String {
    let course = course(config, seed);
    let shown = &course[course.len().saturating_sub(COURSE_SHOWN)..];
    format!("\nthe course of {seed}, its last {} steps:\n{}\n", shown.len(), shown.join("\n"))
}

/// What happens in a scenario, line by line.
fn course(config: &Config, seed: u64) -> Vec<String> {
    let mut world = World::<Real>::new(config, seed);
    world.keep_course();
    world.run_and_tell()
}

fn in_words(report: &Report) -> String {
    let Report { scenarios, threads, seconds, scenarios_per_s, events, deaths, .. } = report;
    let mut text = format!(
        "{scenarios} scenarios in {seconds:.1} s on {threads} threads: {scenarios_per_s:.0} a second\n{events} events, \
         {deaths} deaths of processes, {} learners gone on from a checkpoint, {} episodes trained on\n",
        report.learners_resumed, report.episodes_trained
    );
    if report.broken == 0 {
        text += "every number was trained exactly once and in order, the ledger balanced, no slot was filled twice, and \
                 every run came to its end\n";
    } else {
        text += &format!("{} scenarios BROKE a promise:\n", report.broken);
        for Broken { what, command, .. } in &report.failures {
            text += &format!("  {command}\n    {what}\n");
        }
    }
    text
}
