//! `rit report`: the experimental section of a paper, from runs that are over.

use crate::{cli::ReportOptions, experiments::plain_settings, failure::Failure, output, representations};
use rit_config::open_regular;
use rit_report::{GENERATOR, Measure, Options, Report, ReportError, finished, read, report};
use std::{
    fs::{self, OpenOptions},
    io::{self, Read as _},
    path::{Path, PathBuf},
    process::ExitCode,
};

/// What a report's folder holds, and nothing else.
const ENTRIES: [&str; 5] = [PAGE, "marl-eval.json", "runs.csv", "figures", "tables"];
const PAGE: &str = "index.html";
/// Where in the page its generator is named: well within so many bytes.
const HEAD_BYTES: u64 = 4096;
/// What of it is large, and in the page or in the records already.
const DATA: [&str; 3] = ["marl-eval.json", "runs.csv", "figures"];

/// `rit report`.
///
/// # Errors
/// When runs cannot be compared, or the folder holds something else or cannot be written.
pub fn run(options: &ReportOptions) -> Result<ExitCode, Failure> {
    check(&options.out, options.force)?;
    let input = read(&options.runs)?;
    let settings = Options {
        measure: options.metric.map(Measure::from),
        by: input.keys_by(&options.by),
        pairs: options.pairs.clone(),
        replications: options.replications,
        seed: options.seed,
        plain: plain_settings,
    };
    let (groups, unfinished) = finished(&input, &settings)?;
    let more = vec![representations::section(&groups, options.seed)?];
    let mut made = report(&input, &groups, &unfinished, &settings, more)?;
    if options.without_data {
        made.files.retain(|(path, _)| !DATA.iter().any(|entry| path.starts_with(entry)));
    }
    write(&made, &options.out)?;
    let place = options.out.display();
    if options.json {
        let files: Vec<_> = made.files.iter().map(|(path, _)| options.out.join(path)).collect();
        let answer = serde_json::json!({ "out": options.out, "files": files, "said": made.said });
        output::print(&format!("{answer:#}\n"))?;
    } else {
        output::print(&format!(
            "{}\n{place}/index.html: {} files\n",
            made.said.join("\n"),
            made.files.len()
        ))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Refuses a folder that holds something else than a report, unless it may lie beside it. Asked before the work.
fn check(out: &Path, force: bool) -> Result<(), Failure> {
    let wrong = |error: io::Error| Failure::input_message(format!("--out {}: {error}", out.display()));
    match fs::read_dir(out) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        Err(error) => Err(wrong(error)),
        Ok(entries) => {
            let names: Result<Vec<_>, _> =
                entries.map(|entry| entry.map(|entry| entry.file_name())).collect();
            let names = names.map_err(wrong)?;
            let other = names.iter().find(|name| !ENTRIES.iter().any(|entry| *name == *entry));
            match other {
                Some(other) if !force => Err(Failure::input_message(format!(
                    "--out {} holds something else than a report: {}; choose another folder, or --force writes the report \
                     beside it",
                    out.display(),
                    other.to_string_lossy()
                ))),
                None if !force && !names.is_empty() && !is_report(out) => {
                    Err(Failure::input_message(format!(
                        "--out {} holds {}, and no {PAGE} that names `rit report` as its generator; choose another folder, or \
                         --force replaces what lies there under a report's names",
                        out.display(),
                        names[0].to_string_lossy()
                    )))
                }
                _ => Ok(()),
            }
        }
    }
}

/// Whether the page there says what made it: other programs too make folders of figures and tables.
fn is_report(out: &Path) -> bool {
    let mut head = Vec::new();
    let page = open_regular(&out.join(PAGE), OpenOptions::new().read(true));
    page.and_then(|page| page.take(HEAD_BYTES).read_to_end(&mut head)).is_ok()
        && String::from_utf8_lossy(&head).contains(GENERATOR)
}

/// Writes all of it beside its place, then moves it there part by part: an earlier report's figures do not stay.
fn write(made: &Report, out: &Path) -> Result<(), Failure> {
    let wrong = |error: io::Error| Failure::runtime_message(format!("--out {}: {error}", out.display()));
    fs::create_dir_all(out).map_err(wrong)?;
    let fresh = tempfile::Builder::new().prefix(".report-").tempdir_in(out).map_err(wrong)?;
    for (path, bytes) in &made.files {
        let path = fresh.path().join(path);
        path.parent()
            .map_or(Ok(()), fs::create_dir_all)
            .and_then(|()| fs::write(&path, bytes))
            .map_err(wrong)?;
    }
    for entry in ENTRIES {
        let (from, to) = (fresh.path().join(entry), out.join(entry));
        replace(&from, &to).map_err(wrong)?;
    }
    Ok(())
}

/// Puts one in the place of the other; where there is nothing new, the old goes.
fn replace(from: &Path, to: &PathBuf) -> io::Result<()> {
    match fs::symlink_metadata(to) {
        Ok(there) if there.is_dir() => fs::remove_dir_all(to)?,
        Ok(_) => fs::remove_file(to)?,
        Err(_) => {}
    }
    if from.exists() { fs::rename(from, to) } else { Ok(()) }
}

impl From<ReportError> for Failure {
    fn from(error: ReportError) -> Self {
        match error {
            ReportError::Draw(_) | ReportError::Write(_) => Self::runtime(error),
            _ => Self::input(error),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_and_tables_that_no_report_made_are_not_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path();
        check(out, false).unwrap();
        check(&out.join("new"), false).unwrap();
        for entry in ["figures", "tables"] {
            fs::create_dir(out.join(entry)).unwrap();
        }
        let refused = |out: &Path| check(out, false).unwrap_err().to_string();
        assert!(refused(out).contains("no index.html that names `rit report`"), "{}", refused(out));
        check(out, true).unwrap();
        fs::write(out.join(PAGE), "<!doctype html>\n<title>mine</title>\n").unwrap();
        assert!(refused(out).contains("choose another folder"), "{}", refused(out));
        fs::write(out.join(PAGE), rit_report::page("Comparison of runs", &[], None)).unwrap();
        check(out, false).unwrap();
        fs::write(out.join("thesis.tex"), "").unwrap();
        assert!(refused(out).contains("something else than a report: thesis.tex"), "{}", refused(out));
    }
}
