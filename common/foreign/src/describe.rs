//! What tasks are: asked of Python once, before a run begins, and part of the run's configuration from then on.

use crate::{
    protocol::{Answer, Open, Opened, Request, answer},
    worker::{Launch, Worker},
};
use rit_env::{EnvironmentError, FailureKind, Spec};

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
    match check(&opened) {
        Ok(()) => Ok(*opened),
        Err(detail) => Err(EnvironmentError::new(FailureKind::BadAnswer, detail)),
    }
}

/// Whether there is a task of these sizes, with a name for each feature and action; or what is wrong, in words.
fn check(opened: &Opened) -> Result<(), String> {
    let Opened { n_agents, n_entities, n_features, n_actions, steps_max, has_wins, .. } = *opened;
    let spec = Spec {
        n_agents,
        n_entities,
        feature_dim: n_features,
        n_actions,
        steps_max,
        has_wins,
        has_scenes: false,
        is_reproducible: opened.is_reproducible == Some(true),
    };
    spec.check().map_err(|error| error.to_string())?;
    let named = [
        ("features", n_features, opened.feature_names.len()),
        ("actions", n_actions, opened.action_names.len()),
    ];
    match named.into_iter().find(|(_, count, names)| count != names) {
        Some((what, count, names)) => Err(format!("{names} names for {count} {what}")),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_makes_no_task_is_said() {
        let names = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect();
        let good = Opened {
            n_agents: 2,
            n_entities: 3,
            n_features: 1,
            n_actions: 2,
            steps_max: 5,
            has_wins: false,
            feature_names: names(&["x"]),
            action_names: names(&["stay", "go"]),
            is_reproducible: None,
        };
        assert_eq!(check(&good), Ok(()));
        let refused = |change: &dyn Fn(&mut Opened)| {
            let mut opened = good.clone();
            change(&mut opened);
            check(&opened).unwrap_err()
        };
        let changes: [fn(&mut Opened); 5] = [
            |opened| opened.n_agents = 0,
            |opened| opened.n_entities = 1,
            |opened| (opened.n_features, opened.feature_names) = (0, vec![]),
            |opened| (opened.n_actions, opened.action_names) = (0, vec![]),
            |opened| opened.steps_max = 0,
        ];
        for change in changes {
            let message = refused(&change);
            assert!(message.contains("make no task; it needs at least one agent"), "{message}");
        }
        assert_eq!(refused(&|opened| opened.n_actions = 3), "2 names for 3 actions");
    }
}
