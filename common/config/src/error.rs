//! What can be wrong with a configuration, in words.

use crate::{keys::quoted, resolve::LIVE, saved::FORMAT_VERSION};
use rit_algo::Method;
use rit_env::{SpecError, TaskError, TaskSet, UnknownName};

/// What is wrong with what was typed. Every message is one line, names the key, and says what would do.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ConfigError {
    /// Not TOML.
    #[error("{source_name}, line {line}, column {column}: {reason}")]
    Syntax {
        /// The file.
        source_name: String,
        /// From 1.
        line: usize,
        /// From 1, in characters.
        column: usize,
        /// What the parser said, in one line.
        reason: String,
    },
    /// A run's file of another build.
    #[error(
        "config.toml has format_version {found}, this build reads {FORMAT_VERSION}; go on with the build that wrote it"
    )]
    Format {
        /// Its version.
        found: String,
    },
    /// A run's file that does not say all that weights follow from.
    #[error(
        "config.toml lacks {key}, from which weights follow: an older build wrote it; add the value that the run was \
         trained with"
    )]
    Incomplete {
        /// The key.
        key: String,
    },
    /// A setting that sets nothing.
    #[error("--set {0}: write --set section.key=value, such as --set algorithm.lr=0.0005")]
    NoAssignment(String),
    /// No such key.
    #[error("unknown key {key}; {advice}")]
    UnknownKey {
        /// The key, in quotes.
        key: String,
        /// The key that was meant, perhaps, or those there are.
        advice: String,
    },
    /// A value of another kind.
    #[error("{key} must be {expected}, not {found}")]
    Kind {
        /// The key.
        key: String,
        /// The kind it must have.
        expected: &'static str,
        /// What it is, and what to write instead where that is clear.
        found: String,
    },
    /// A number out of its range.
    #[error("{key} = {value} is out of range {min}..={max}")]
    Range {
        /// The key.
        key: String,
        /// Its value, its smallest and its largest, in digits that lead back to them.
        value: String,
        /// See above.
        min: String,
        /// See above.
        max: String,
    },
    /// A number that changes nothing in this task set.
    #[error("{key} means nothing to {task_set}; leave it out")]
    Meaningless {
        /// The key.
        key: &'static str,
        /// The task set.
        task_set: TaskSet,
    },
    /// Real games of a task set that has none.
    #[error("environment.backend = \"starcraft\" plays combat, and {task_set} is none; leave it out")]
    NoBattles {
        /// The task set.
        task_set: TaskSet,
    },
    /// A key that changes nothing where the environments play.
    #[error("{key} means nothing with environment.backend = {backend:?}; leave it out")]
    NotOfBackend {
        /// The key.
        key: &'static str,
        /// Where they play.
        backend: &'static str,
    },
    /// An end that never comes.
    #[error(
        "training.until = \"{until}\": the tasks of {task_set} know no winning, so that is never reached; write \
         mean_return=NUMBER"
    )]
    NoWins {
        /// What was asked for.
        until: String,
        /// The task set.
        task_set: TaskSet,
    },
    /// A name that is no task of the set.
    #[error("{key}: {error}")]
    Task {
        /// The key.
        key: &'static str,
        /// What is wrong with the name.
        error: TaskError,
    },
    /// A task that is listed twice, under one name or two.
    #[error("{key} lists one task twice, as {first} and as {second}; leave one out")]
    TaskTwice {
        /// The key.
        key: &'static str,
        /// What it is called first.
        first: String,
        /// What it is called then.
        second: String,
    },
    /// Environments in Python and a task set of ours.
    #[error(
        "environment.python and environment.task_set = {task_set} both say what is played; leave one out"
    )]
    TwoTaskSets {
        /// The task set, in quotes.
        task_set: String,
    },
    /// Tasks in Python, and nothing that makes them.
    #[error("environment.python is missing: write \"MODULE:FUNCTION\"")]
    NoPython,
    /// No task to learn from.
    #[error(
        "environment.training_tasks names no task; name those to learn from, by which environment.python makes them"
    )]
    NoTrainingTasks,
    /// Python has not been asked yet.
    #[error(
        "environment.worlds says nothing of the tasks: `rit train` and `rit learner --new` ask environment.python for it"
    )]
    NoWorlds,
    /// A task that Python was not asked for.
    #[error("environment.worlds does not know {task}; begin a new run with this task among its tasks")]
    NoWorld {
        /// The task, in quotes.
        task: String,
    },
    /// Sizes that make no task.
    #[error("environment.worlds: task {task}: {error}")]
    WorldSizes {
        /// The task, in quotes.
        task: String,
        /// What is wrong with them.
        error: SpecError,
    },
    /// Sizes beyond what an episode can have.
    #[error("the sizes that hold every training and testing task: {0}; name other tasks")]
    Dims(#[from] rit_episode::DimsError),
    /// A key of environments in Python.
    #[error("{key} means nothing without environment.python; leave it out")]
    NotOfPython {
        /// The key.
        key: String,
    },
    /// A key that this method has no use for.
    #[error("{key} means nothing to {method}; these have it: {owners}")]
    NotOfMethod {
        /// The key.
        key: String,
        /// The method.
        method: Method,
        /// Who has it.
        owners: String,
    },
    /// A name that no method has.
    #[error(
        "unknown algorithm {}; {}known: {}",
        quoted(name),
        suggestion.map_or(String::new(), |known| format!("did you mean {known:?}? ")),
        Method::ALL.map(Method::name).join(", ")
    )]
    UnknownMethod {
        /// The name.
        name: String,
        /// The name that looks most like it.
        suggestion: Option<&'static str>,
    },
    /// Another method for a run that has begun.
    #[error("the run was begun with the algorithm {method} and cannot go on with {name}; start a new one")]
    OtherMethod {
        /// The run's.
        method: Method,
        /// What was typed.
        name: Method,
    },
    /// Weights that are older than an on-policy method can learn with.
    #[error(
        "algorithm.policy_lag = {policy_lag}: {method} learns from each batch with the weights that rolled it; only 0 will do"
    )]
    OnPolicyLag {
        /// The method.
        method: Method,
        /// What was typed.
        policy_lag: usize,
    },
    /// A word that is not one of a key's choices.
    #[error("{key} = {found} is not one of: {choices}")]
    Choice {
        /// The key.
        key: String,
        /// The word, in quotes.
        found: String,
        /// What may be written.
        choices: String,
    },
    /// A word that means nothing there.
    #[error(transparent)]
    Name(#[from] UnknownName),
    /// An experiment that does not say what to train on.
    #[error("the experiment names no environment.task_set; known: {known}")]
    NoTaskSet {
        /// Those there are.
        known: String,
    },
    /// A key that a run under way cannot change.
    #[error("{key} cannot change in a run that has begun; start a new one")]
    Fixed {
        /// The key.
        key: String,
    },
    /// No actor would roll episodes.
    #[error(
        "actors.count = 0 leaves the run without an actor that rolls episodes; `rit ctl pause` lets it rest, and with actors.remote \
         actors on other hosts may do all of it"
    )]
    NoActors,
    /// A key that a running learner cannot change.
    #[error("{key} cannot change while the learner runs; these can: {}", LIVE.join(", "))]
    NotLive {
        /// The key.
        key: String,
    },
    /// Values that cannot go together.
    #[error(transparent)]
    Model(#[from] rit_algo::ConfigError),
    /// What is left for the deserialiser to find. The types name the key and what would do.
    #[error("{0}")]
    Value(String),
}
