//! A run that is over: what its run directory says of it.

use crate::{failure::Failure, report};
use rit_config::{RunDir, TEXT_BYTES_MAX, open_regular, read_regular};
use rit_learner::{metrics::Line, summary::check_format};
use rit_policy::place::LATEST;
use rit_proto::v1::TaskResult;
use serde_json::{Value, json};
use std::{
    fs::{self, OpenOptions},
    io::{BufRead as _, BufReader},
    path::PathBuf,
};

/// What a run came to.
#[derive(Clone, Debug)]
pub struct Finished {
    root: PathBuf,
    summary: Value,
}

impl Finished {
    /// What the run's summary says.
    ///
    /// # Errors
    /// When there is none, or it is none.
    pub fn read(run_dir: &RunDir) -> Result<Self, Failure> {
        let path = run_dir.summary();
        let named = |what: String| Failure::runtime_message(format!("{}: {what}", path.display()));
        let text = read_regular(&path, TEXT_BYTES_MAX).map_err(|error| named(error.to_string()))?;
        let summary =
            serde_json::from_slice(&text).map_err(|error| named(format!("it was altered: {error}")))?;
        check_format(&summary).map_err(|error| named(error.to_string()))?;
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
        let trained = newest.and_then(|newest| newest.to_str()?.rsplit('-').next()?.parse::<u64>().ok());
        Ok((trained.unwrap_or(0) <= finished.number("env_steps")).then_some(finished))
    }

    /// For people; a run that did not finish says first how it ended.
    pub fn text(&self) -> String {
        match self.how().as_str() {
            "" | "finished" => self.figures(),
            how => format!("{}\n{}", report::printable(how), self.figures()),
        }
    }

    /// How it ended, in a word; nothing where that was altered.
    pub fn ended(&self) -> &str {
        self.summary["ended"].as_str().unwrap_or_default()
    }

    /// How far training came.
    pub fn env_steps(&self) -> u64 {
        self.number("env_steps")
    }

    /// How it ended, and why if it failed.
    fn how(&self) -> String {
        let word = |key: &str| self.summary[key].as_str().unwrap_or_default();
        match (word("ended"), word("reason")) {
            ("until", _) => "finished: the goal of training.until is reached".to_owned(),
            (ended, "") => ended.to_owned(),
            (ended, reason) => format!("{ended}: {reason}"),
        }
    }

    fn figures(&self) -> String {
        let evaluation = self.summary["evaluation"].as_object();
        let results: Vec<TaskResult> = evaluation.into_iter().flatten().map(task_result).collect();
        let digest = self.summary["weights_digest"].as_str();
        format!(
            "{} environment steps, {} episodes, {} updates in {}\n{}{}run directory  {}\n",
            report::grouped(self.number("env_steps")),
            report::grouped(self.number("episodes")),
            report::grouped(self.number("updates")),
            report::duration(self.summary["wall_s"].as_f64().unwrap_or_default()),
            // One that failed was not evaluated at its end.
            if results.is_empty() { String::new() } else { report::table(&results) },
            digest.map_or_else(String::new, |digest| format!("weights digest {digest}\n")),
            self.root.display()
        )
    }

    /// The summary itself.
    pub fn json(&self) -> String {
        format!("{:#}\n", self.summary)
    }

    /// How the run stands, for people: it is over.
    pub fn status_text(&self) -> String {
        let said: Vec<_> = ["ended", "reason"].iter().filter_map(|&key| self.summary[key].as_str()).collect();
        let how = if said.is_empty() { String::new() } else { format!(": {}", said.join(", ")) };
        format!("the run is over{}\n{}", report::printable(&how), self.figures())
    }

    /// The same for programs, which know a running run by its `state` too.
    pub fn status_json(&self) -> String {
        format!("{:#}\n", json!({ "state": "over", "summary": self.summary }))
    }

    /// Why nothing can be asked of it any more, and what to do instead.
    pub fn refusal(&self) -> Failure {
        let root = self.root.display();
        let steps = report::grouped(self.number("env_steps"));
        Failure::runtime_message(format!(
            "the run is over, at {steps} environment steps: `rit ctl --run {root} status` shows what it came to, `rit \
             evaluate --run {root}` measures its weights, `rit train --resume {root} --steps N` goes on with it"
        ))
    }

    /// Why nobody serves its page, and what to do instead.
    pub fn no_page(&self) -> Failure {
        let root = self.root.display();
        Failure::runtime_message(format!(
            "the run is over and its page with it: `rit ctl --run {root} status` shows what it came to, `rit plot {root} \
             --out curves.svg` draws its curves"
        ))
    }

    fn number(&self, key: &str) -> u64 {
        self.summary[key].as_u64().unwrap_or_default()
    }
}

/// What was measured of a run at or behind so many environment steps. A line that is none is left out.
///
/// # Errors
/// When the file cannot be read.
pub fn metrics(run_dir: &RunDir, from_env_steps: u64) -> Result<impl Iterator<Item = Line>, Failure> {
    let path = run_dir.metrics();
    let file = open_regular(&path, OpenOptions::new().read(true))
        .map_err(|error| Failure::runtime_message(format!("{}: {error}", path.display())))?;
    let lines = BufReader::new(file).split(b'\n').map_while(Result::ok);
    let lines = lines.filter_map(|line| serde_json::from_slice::<Line>(&line).ok());
    Ok(lines.filter(move |line| line.progress().env_steps >= from_env_steps))
}

fn task_result((task, result): (&String, &Value)) -> TaskResult {
    TaskResult {
        task: task.clone(),
        episodes: result["episodes"].as_u64().unwrap_or_default(),
        mean_return: result["mean_return"].as_f64().unwrap_or_default(),
        win_rate: result["win_rate"].as_f64(),
        ..TaskResult::default()
    }
}
