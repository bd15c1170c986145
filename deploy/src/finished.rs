//! A run that is over: what its run directory says of it.

use crate::{failure::Failure, report};
use rit_config::RunDir;
use rit_learner::messages;
use rit_policy::place::LATEST;
use rit_proto::v1::{MetricsLine, TaskResult};
use rit_record::{Ended, Lines, Summary};
use serde_json::json;
use std::{
    fs,
    path::{Path, PathBuf},
};

/// What a run came to.
#[derive(Clone, Debug)]
pub struct Finished {
    root: PathBuf,
    summary: Summary,
}

impl Finished {
    /// What the run's summary says.
    ///
    /// # Errors
    /// When there is none, or it is none.
    pub fn read(run_dir: &RunDir) -> Result<Self, Failure> {
        let path = run_dir.summary();
        let named = |what: String| Failure::runtime_message(format!("{}: {what}", path.display()));
        let summary = Summary::read(run_dir).map_err(|error| {
            // What is no JSON, or no summary.
            let altered =
                error.get_ref().is_some_and(|inner| inner.downcast_ref::<serde_json::Error>().is_some());
            named(if altered { format!("it was altered: {error}") } else { error.to_string() })
        })?;
        let summary = summary.ok_or_else(|| named("there is none yet".to_owned()))?;
        Ok(Self { root: run_dir.root().to_owned(), summary })
    }

    /// The run's end, if it has come to one that nothing was trained after. Meant for a run without a learner.
    ///
    /// # Errors
    /// When the summary that is there cannot be read.
    pub fn of(run_dir: &RunDir) -> Result<Option<Self>, Failure> {
        if !run_dir.summary().exists() {
            return Ok(None);
        }
        let finished = Self::read(run_dir)?;
        let newest = fs::read_link(run_dir.checkpoints().join(LATEST)).ok();
        // The steps, which a number follows where there are several at that step.
        let trained = newest.and_then(|newest| newest.to_str()?.split('-').nth(1)?.parse::<u64>().ok());
        Ok((trained.unwrap_or(0) <= finished.summary.progress.env_steps).then_some(finished))
    }

    /// For people; a run that did not finish says first how it ended.
    pub fn text(&self) -> String {
        match self.summary.ended {
            Ended::Finished => self.figures(),
            ended => format!("{ended}{}\n{}", self.reason(": "), self.figures()),
        }
    }

    /// Why it failed, if it did, after this.
    fn reason(&self, after: &str) -> String {
        let reason = self.summary.reason.as_deref();
        reason.map_or_else(String::new, |reason| report::printable_sentence(&format!("{after}{reason}")))
    }

    fn figures(&self) -> String {
        let Summary { progress, wall_s, weights_digest, evaluation, .. } = &self.summary;
        let results: Vec<TaskResult> = evaluation.values().map(messages::task_result).collect();
        format!(
            "{} environment steps, {} episodes, {} updates in {}\n{}{}run directory  {}\n",
            report::grouped(progress.env_steps),
            report::grouped(progress.episodes),
            report::grouped(progress.updates),
            report::duration(*wall_s),
            // One that failed was not evaluated at its end.
            if results.is_empty() {
                String::new()
            } else {
                report::brief_table(&results, "summary.json has all")
            },
            weights_digest.as_ref().map_or_else(String::new, |digest| format!("weights digest {digest}\n")),
            self.root.display()
        )
    }

    /// The summary itself.
    pub fn json(&self) -> String {
        format!("{:#}\n", json!(self.summary))
    }

    /// How the run stands, for people: it is over.
    pub fn status_text(&self) -> String {
        let ended = self.summary.ended.word();
        format!("the run is over: {ended}{}\n{}", self.reason(", "), self.figures())
    }

    /// The same for programs, which know a running run by its `state` too.
    pub fn status_json(&self) -> String {
        format!("{:#}\n", json!({ "state": "over", "summary": self.summary }))
    }

    /// Why nothing can be asked of it any more, and what to do instead.
    pub fn refusal(&self) -> Failure {
        let root = self.root.display();
        let steps = report::grouped(self.summary.progress.env_steps);
        Failure::runtime_message(format!(
            "the run is over, at {steps} environment steps: `rit ctl --run {root} status` shows what it came to, `rit \
             evaluate --run {root}` measures its weights, `rit train --resume {root} --steps N` goes on with it"
        ))
    }

    /// Why its page is not served, and what to do instead.
    pub fn no_page(&self) -> Failure {
        let root = self.root.display();
        Failure::runtime_message(format!(
            "the run is over and its page with it: `rit ctl --run {root} status` shows what it came to, `rit serve {root}` \
             its curves and episodes in a browser"
        ))
    }
}

/// What was measured of a run at or after so many environment steps. A line that is none is left out.
#[derive(Debug)]
pub struct Metrics {
    lines: Lines,
    from_env_steps: u64,
}

impl Metrics {
    /// Begins to read.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn open(path: &Path, from_env_steps: u64) -> Result<Self, Failure> {
        Ok(Self { lines: Lines::open(path).map_err(Failure::runtime)?, from_env_steps })
    }

    /// The next line; none at the end.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn next_line(&mut self) -> Result<Option<MetricsLine>, Failure> {
        while let Some(line) = self.lines.next_line().map_err(Failure::runtime)? {
            if let Some(line) = messages::line(&line).filter(|line| line.env_steps >= self.from_env_steps) {
                return Ok(Some(line));
            }
        }
        Ok(None)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiments;
    use rit_config::OwnedRunDir;
    use rit_record::Progress;
    use std::os::unix::fs::symlink;

    #[test]
    fn a_run_that_was_trained_after_its_summary_is_not_over() {
        let folder = tempfile::tempdir().unwrap();
        let config = experiments::load("matrix-game", &[]).unwrap().config;
        let owned = OwnedRunDir::create(&folder.path().join("run"), &config).unwrap();
        let run_dir = owned.run_dir();
        let progress = Progress { env_steps: 400, ..Progress::default() };
        Summary { progress, ..Summary::default() }.write(run_dir).unwrap();
        fs::create_dir_all(run_dir.checkpoints()).unwrap();
        let latest = run_dir.checkpoints().join(LATEST);
        for (newest, is_over) in [
            ("step-000000000400", true),
            ("step-000000000400-2", true),
            ("step-000000000800", false),
            ("step-000000000800-2", false),
        ] {
            symlink(newest, &latest).unwrap();
            assert_eq!(Finished::of(run_dir).unwrap().is_some(), is_over, "{newest}");
            fs::remove_file(&latest).unwrap();
        }
    }
}
