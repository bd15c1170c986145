//! Why there is no report.

use rit_record::RecordError;

/// Why runs cannot be compared, or the comparison not be drawn.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// A run cannot be read.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// Nothing to say yet.
    #[error(
        "none of {0} has finished; a report is of finished runs (`rit sweep status DIR` shows how a sweep stands)"
    )]
    NoneFinished(String),
    /// Their mean would be of nothing.
    #[error(transparent)]
    Kinds(#[from] Box<OtherKind>),
    /// A run counts once.
    #[error("{first} and {second} are the same run{}: give it once", seed_words(*.seed))]
    Twice {
        /// A run.
        first: String,
        /// The same.
        second: String,
        /// Their seed, where it is known.
        seed: Option<u64>,
    },
    /// Their curves have no points in common.
    #[error(
        "{first} was evaluated every {} environment steps, {second} every {}: their curves cannot be compared; train one \
         of them again with the other's evaluation.every_env_steps",
        interval.0, interval.1
    )]
    Intervals {
        /// A run.
        first: String,
        /// A run of another method.
        second: String,
        /// How often.
        interval: (String, String),
    },
    /// Different programs.
    #[error(
        "{first} was trained by version {} and {second} by version {}; a report compares runs of one version: leave the \
         older ones out, or train them again",
        versions.0, versions.1
    )]
    Versions {
        /// A run.
        first: String,
        /// Another on the same tasks.
        second: String,
        /// Their versions.
        versions: (String, String),
    },
    /// What is asked for was not measured.
    #[error("{run} has no {what} of {task}; its evaluations do not measure it")]
    Missing {
        /// The run.
        run: String,
        /// The measure.
        what: String,
        /// The task.
        task: String,
    },
    /// A pair that names no method.
    #[error("--pair: there is no method {name}; the methods are {}", known.join(", "))]
    Pair {
        /// As it was given.
        name: String,
        /// What there is.
        known: Vec<String>,
    },
    /// A key to tell methods apart by that no run has.
    #[error("--by {0}: no run has this key")]
    By(String),
    /// The picture cannot be made.
    #[error("a figure cannot be drawn: {0}")]
    Draw(String),
    /// A file of the report cannot be made.
    #[error("{0}")]
    Write(String),
}

/// Two runs of one method that are not of one kind.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{first} and {second} are both {method} on {task_set}, but differ in {}; runs of different configurations are not \
     averaged: leave one out, or give {} to compare them",
    shortened(differences),
    remedy(by)
)]
pub struct OtherKind {
    /// A run.
    pub first: String,
    /// Another.
    pub second: String,
    /// The method.
    pub method: String,
    /// Where they were trained.
    pub task_set: String,
    /// "key (one value, the other)".
    pub differences: Vec<String>,
    /// The keys.
    pub by: Vec<String>,
}

/// Records without settings differ from others in every key: no more than these are said.
const SHOWN_MAX: usize = 8;

fn shortened(differences: &[String]) -> String {
    let shown = differences.iter().take(SHOWN_MAX).map(String::as_str).collect::<Vec<_>>().join(", ");
    match differences.len().saturating_sub(SHOWN_MAX) {
        0 => shown,
        more => format!("{shown} and {more} more"),
    }
}

fn remedy(by: &[String]) -> String {
    match by.iter().find(|key| *key == "folder") {
        // A record without settings: its folder tells it apart.
        Some(folder) => format!("--by {folder}"),
        None => by.iter().map(|key| format!("--by {key}")).collect::<Vec<_>>().join(" "),
    }
}

fn seed_words(seed: Option<u64>) -> String {
    seed.map_or_else(String::new, |seed| format!(", seed {seed}"))
}
