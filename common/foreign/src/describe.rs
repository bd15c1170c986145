//! What tasks are: asked of Python once, before a run begins, and part of the run's configuration from then on.

use crate::{
    protocol::{Answer, Open, Opened, Request, answer},
    worker::{Launch, Worker},
};
use rit_env::{EnvironmentError, FailureKind};

/// What the tasks of a run are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Described {
    /// By task, in the order in which they were asked for.
    pub tasks: Vec<(String, Opened)>,
    /// What features are called, as many as the task with the most has.
    pub feature_names: Vec<String>,
    /// What actions are called, likewise.
    pub action_names: Vec<String>,
}

/// Why tasks cannot be described.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("task {task:?}: {error}")]
pub struct DescribeError {
    /// The task that was asked for.
    pub task: String,
    /// What happened.
    #[source]
    pub error: EnvironmentError,
}

/// Asks a worker what these tasks are.
///
/// # Errors
/// When Python cannot be started, or an environment cannot be made.
pub fn describe(launch: &Launch, tasks: &[String]) -> Result<Described, DescribeError> {
    let mut worker = Worker::start(launch)
        .map_err(|error| DescribeError { task: tasks.first().cloned().unwrap_or_default(), error })?;
    let mut described = Vec::new();
    for task in tasks {
        let opened = ask(&mut worker, task).map_err(|error| DescribeError { task: task.clone(), error })?;
        described.push((task.clone(), opened));
    }
    let names = |of: fn(&Opened) -> &Vec<String>| {
        let longest = described.iter().map(|(_, opened)| of(opened)).max_by_key(|names| names.len());
        longest.cloned().unwrap_or_default()
    };
    Ok(Described {
        feature_names: names(|opened| &opened.feature_names),
        action_names: names(|opened| &opened.action_names),
        tasks: described,
    })
}

fn ask(worker: &mut Worker, task: &str) -> Result<Opened, EnvironmentError> {
    let environment = worker.take_place();
    let open = Open { task: task.to_owned(), n_features: 0, n_actions: 0, describe: true };
    worker.send(Request::Open, environment, &serde_json::to_vec(&open).unwrap_or_default())?;
    let (kind, body) = worker.receive(environment)?;
    let opened = match answer(kind, &body) {
        Ok(Answer::Opened(opened)) => opened,
        Ok(Answer::Failed(failed)) => return Err(worker.raised(*failed)),
        Ok(_) => return Err(worker.misspoke(&"it did not say what the environment is")),
        Err(error) => return Err(worker.misspoke(&error)),
    };
    worker.give_up(environment);
    let Opened { n_agents, n_entities, n_features, n_actions, steps_max, .. } = *opened;
    let named = [
        ("features", n_features, opened.feature_names.len()),
        ("actions", n_actions, opened.action_names.len()),
    ];
    let fault = if n_agents == 0
        || n_entities < n_agents
        || n_features == 0
        || n_actions == 0
        || steps_max == 0
    {
        Some(format!(
            "{n_agents} agents, {n_entities} entities (agents included), {n_features} features, {n_actions} actions and \
             {steps_max} steps make no task"
        ))
    } else {
        let wrong = named.into_iter().find(|(_, count, names)| count != names);
        wrong.map(|(what, count, names)| format!("{names} names for {count} {what}"))
    };
    match fault {
        Some(detail) => Err(EnvironmentError::new(FailureKind::BadAnswer, detail)),
        None => Ok(*opened),
    }
}
