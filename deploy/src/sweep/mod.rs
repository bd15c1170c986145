//! `rit sweep`: the runs of a comparison, side by side on this machine, or as jobs of a cluster.

mod cluster;
mod costs;
mod file;
mod log;
mod plan;
mod run;
mod screen;
mod standing;

use crate::{
    cli::{SweepCommand, SweepOptions},
    failure::Failure,
    logging::LogOptions,
    new_file, output,
};
use file::SweepFile;
use plan::Plan;
use rit_record::{CellState, Record, Sweep};
use run::Share;
use serde_json::json;
use standing::{Standing, State};
use std::{
    fs::{self, DirBuilder, File, TryLockError},
    os::unix::fs::DirBuilderExt as _,
    path::Path,
    process::ExitCode,
};

/// `rit sweep`.
///
/// # Errors
/// When the file or the folder cannot be used.
pub async fn run(options: SweepOptions, logs: LogOptions) -> Result<ExitCode, Failure> {
    match &options.command {
        Some(SweepCommand::Status { dir, json }) => return status(dir, *json),
        Some(SweepCommand::Collect { dir, out }) => return collect(dir, out),
        None => {}
    }
    let missing = |what: &str| Failure::input_message(format!("give {what}; `rit sweep --help` shows how"));
    let path = options.file.as_ref().ok_or_else(|| missing("a sweep's file"))?;
    let file = SweepFile::read(path)?;
    let plan = Plan::new(&file)?;
    if options.dry_run {
        return dry_run(options.dir.as_deref(), &file.folder, &plan, options.json);
    }
    let dir = options.dir.as_ref().ok_or_else(|| missing("--dir DIR, where the runs shall lie"))?;
    let cluster = [&options.slurm, &options.kubernetes].into_iter().flatten().next();
    cluster.map_or(Ok(()), |out| new_file::check(out, options.force))?;
    prepare(dir, &plan.sweep)?;
    let dir = dir.canonicalize().map_err(Failure::runtime)?;
    let job = || cluster::Job::new(path, &dir, &plan.sweep, options.jobs, options.queue.as_deref());
    if let Some(out) = &options.slurm {
        return write("--slurm", out, &cluster::slurm(&job()?), options.force);
    }
    if let Some(out) = &options.kubernetes {
        return write("--kubernetes", out, &cluster::kubernetes(&job()?)?, options.force);
    }
    if let Some(index) = options.cell {
        return one(&dir, &plan, index, &options, logs).await;
    }
    all(&dir, &plan, &options).await
}

/// Lists the cells, and what they will take by the finished ones and by the records that lie beside the sweep's file.
fn dry_run(dir: Option<&Path>, folder: &Path, plan: &Plan, json: bool) -> Result<ExitCode, Failure> {
    let mut standings = match dir {
        Some(dir) => {
            check(dir, &plan.sweep)?;
            standing::of_all(dir, plan)
        }
        None => {
            let cells = plan.sweep.cells.iter().zip(&plan.configs);
            cells.map(|(cell, config)| Standing::waiting(cell, config)).collect()
        }
    };
    // A folder without records is as good.
    let found = rit_record::discover(&[folder.to_owned()]).unwrap_or_default();
    let records: Vec<Record> = found.iter().filter_map(|path| Record::read(path).ok()).collect();
    standing::estimate(plan, &records, &mut standings);
    print(&standings, json)
}

/// Runs one cell in this process, which ends as its run ends: what each job of an array does.
async fn one(
    dir: &Path,
    plan: &Plan,
    index: usize,
    options: &SweepOptions,
    logs: LogOptions,
) -> Result<ExitCode, Failure> {
    let count = plan.sweep.cells.len();
    let cell = plan.sweep.cells.get(index).ok_or_else(|| {
        Failure::input_message(format!("--cell {index}: the sweep's cells are 0 to {}", count - 1))
    })?;
    match standing::of_cell(dir, cell, &plan.configs[index]) {
        Standing { state: State::Finished, .. } => {
            output::say(&format!("{}: finished already", cell.name)).map_err(Failure::runtime)?;
            return Ok(ExitCode::SUCCESS);
        }
        Standing { state: State::Diverged, reason, .. } if !options.retry => {
            let (name, why) = (&cell.name, reason.unwrap_or_default());
            return Err(Failure::runtime_message(format!("{name}: {why}; --retry tries again")));
        }
        _ => {}
    }
    let arguments = run::train_arguments(dir, cell, Share::of_this_machine(Some(1)));
    let options = crate::cli::train(&arguments, options.json).map_err(Failure::runtime)?;
    let ended = crate::train::run(options, logs).await;
    if let Err(failure) = &ended {
        // Whatever becomes of the line, the exit code says it.
        let _ = log::append(dir, cell, &format!("{}{failure}", Sweep::ERROR));
    }
    ended
}

/// Runs all that is not finished, on this machine.
async fn all(dir: &Path, plan: &Plan, options: &SweepOptions) -> Result<ExitCode, Failure> {
    // Of two sweeps in one folder the second would start what the first has just not begun yet.
    let folder = File::open(dir).map_err(Failure::runtime)?;
    match folder.try_lock() {
        Err(TryLockError::WouldBlock) => {
            let dir = dir.display();
            return Err(Failure::input_message(format!(
                "another `rit sweep` runs in {dir}; `rit sweep status {dir}` shows how it stands"
            )));
        }
        // A file system that locks no folders: the second of two sweeps there finds the runs' own locks.
        Err(TryLockError::Error(_)) | Ok(()) => {}
    }
    let share = Share::of_this_machine(options.jobs);
    let outcome = run::run_all(dir, plan, share, options.retry, options.json).await;
    print(&standing::of_all(dir, plan), options.json)?;
    for (cell, why) in outcome.failed.iter().chain(&outcome.left) {
        let _ = output::say(&format!("{cell}: {}", crate::report::printable_sentence(why)));
    }
    Ok(match outcome {
        run::Outcome { interrupted: true, .. } => ExitCode::from(130),
        run::Outcome { failed, left, .. } if failed.is_empty() && left.is_empty() => ExitCode::SUCCESS,
        _ => ExitCode::FAILURE,
    })
}

/// The sweep of a folder.
fn open(dir: &Path) -> Result<Sweep, Failure> {
    let none = || Failure::input_message(format!("{} holds no sweep: it has no sweep.json", dir.display()));
    Sweep::read(dir).map_err(Failure::input)?.ok_or_else(none)
}

/// `rit sweep status`.
fn status(dir: &Path, json: bool) -> Result<ExitCode, Failure> {
    let sweep = open(dir)?;
    let configs = sweep.cells.iter().map(plan::resolve).collect::<Result<_, _>>()?;
    print(&standing::of_all(dir, &Plan { sweep, configs }), json)
}

/// `rit sweep collect`.
fn collect(dir: &Path, out: &Path) -> Result<ExitCode, Failure> {
    let sweep = open(dir)?;
    fs::create_dir_all(out).map_err(|error| new_file::failure("--out", out, &error))?;
    let (mut new, mut there, mut open) = (0, 0, 0);
    for cell in &sweep.cells {
        let stem = out.join(&cell.name);
        if out.join(format!("{}.json", cell.name)).exists() {
            there += 1;
        } else if matches!(Sweep::state(dir, cell), CellState::Ended(ended) if ended.is_whole()) {
            rit_record::commit(&Sweep::run_dir(dir, cell), &stem).map_err(Failure::runtime)?;
            new += 1;
        } else {
            open += 1;
        }
    }
    let out = out.display();
    output::print(&format!("{out}: {new} new records, {there} were there; {open} cells are not finished\n"))?;
    Ok(ExitCode::SUCCESS)
}

fn print(standings: &[Standing], json: bool) -> Result<ExitCode, Failure> {
    output::print(&if json { in_json(standings)? } else { standing::table(standings) })?;
    Ok(ExitCode::SUCCESS)
}

fn in_json(standings: &[Standing]) -> Result<String, Failure> {
    let count = |state| standings.iter().filter(|standing| standing.state == state).count();
    let counts: serde_json::Map<_, _> =
        State::ALL.iter().map(|&state| (state.word().replace(' ', "_"), count(state).into())).collect();
    let answer = json!({ "cells": standings, "counts": counts });
    serde_json::to_string_pretty(&answer).map(|text| text + "\n").map_err(Failure::runtime)
}

/// Whether the folder may hold this sweep: it is empty, or holds it, or a smaller one with the same cells.
fn check(dir: &Path, sweep: &Sweep) -> Result<(), Failure> {
    let shown = dir.display();
    if let Some(before) = Sweep::read(dir).map_err(Failure::input)? {
        let other = before.cells.iter().find(|cell| !sweep.cells.contains(cell));
        return other.map_or(Ok(()), |cell| {
            Err(Failure::input_message(format!(
                "{shown} holds another sweep: its cell {} is not in the file, or has other settings there; choose \
                 another --dir, or give the file that it was made with",
                cell.name
            )))
        });
    }
    match fs::read_dir(dir) {
        Ok(mut entries) => match entries.next() {
            Some(Ok(entry)) => Err(Failure::input_message(format!(
                "{shown} holds something else than a sweep, {:?} lies there; choose another --dir",
                entry.file_name()
            ))),
            Some(Err(error)) => Err(Failure::input_message(format!("{shown}: {error}"))),
            None => Ok(()),
        },
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(()),
        Err(error) => Err(Failure::input_message(format!("{shown}: {error}"))),
    }
}

/// Makes the folder and writes the manifest, if it is not there as it should be.
fn prepare(dir: &Path, sweep: &Sweep) -> Result<(), Failure> {
    check(dir, sweep)?;
    let made = DirBuilder::new().recursive(true).mode(0o700).create(dir);
    made.map_err(|error| Failure::input_message(format!("{}: {error}", dir.display())))?;
    if Sweep::read(dir).map_err(Failure::input)?.as_ref() != Some(sweep) {
        sweep.write(dir).map_err(Failure::runtime)?;
    }
    Ok(())
}

fn write(option: &str, out: &Path, text: &str, force: bool) -> Result<ExitCode, Failure> {
    new_file::write(option, out, text.as_bytes(), force)?;
    let _ = output::say(&format!("{} is written", out.display()));
    Ok(ExitCode::SUCCESS)
}
