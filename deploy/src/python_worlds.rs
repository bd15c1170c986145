//! Environments in Python: what a run has to ask before it begins, and `rit env check`.

use crate::{cli::EnvCheckOptions, experiments, failure::Failure, output, report, traceback::marked};
use rit_config::{Config, PythonAsked, World, python_answered, python_asked};
use rit_env::Split;
use rit_foreign::{Checked, Described, Launch};
use serde_json::json;
use std::process::ExitCode;
use toml::Table;

/// What Python says of an experiment's tasks, as settings; nothing where there is nothing to ask.
///
/// # Errors
/// When Python cannot be started, or does not make them.
pub fn described(text: &str, source_name: &str, settings: &[Table]) -> Result<Option<Table>, Failure> {
    let Some(PythonAsked { environment, tasks }) = python_asked(text, source_name, settings)? else {
        return Ok(None);
    };
    let said = rit_foreign::describe(&Launch::of(&environment), &tasks);
    let Described { tasks, feature_names, action_names } = said.map_err(|error| {
        // The message is one line; who wrote the environment wants to see more.
        let _ = error.error.traceback.as_ref().map(|traceback| output::say(&marked(traceback)));
        Failure::input_message(format!("environment.python = {:?}, {error}", environment.python))
    })?;
    let world = |(task, opened): (String, rit_foreign::protocol::Opened)| World {
        task,
        n_agents: opened.n_agents,
        n_entities: opened.n_entities,
        steps_max: opened.steps_max,
        has_wins: opened.has_wins,
        is_reproducible: opened.is_reproducible.unwrap_or(false),
    };
    let worlds: Vec<World> = tasks.into_iter().map(world).collect();
    Ok(Some(python_answered(&worlds, &feature_names, &action_names)?))
}

/// What is said of a run with environments that keep their own chance.
pub fn not_reproducible(config: &Config) -> Option<String> {
    let chance = config.environment.worlds.iter().filter(|world| !world.is_reproducible);
    let tasks = chance.map(|world| world.task.as_str()).collect::<Vec<_>>().join(", ");
    (!tasks.is_empty()).then(|| {
        format!("the same seed does not give the same episode of {tasks}: the same run is not the same again")
    })
}

/// `rit env check`.
pub fn check(options: &EnvCheckOptions) -> Result<ExitCode, Failure> {
    let mut settings = options.settings.clone();
    if let Some(python) = &options.python {
        settings.push(format!("environment.python={python:?}"));
    }
    if !options.tasks.is_empty() {
        settings.push(format!("environment.training_tasks={:?}", options.tasks));
    }
    let config = match &options.experiment {
        Some(experiment) => experiments::load(experiment, &settings)?.config,
        None => experiments::resolve_text("", "the command line", &settings)?,
    };
    let worlds = rit_worlds::factory(&config);
    let mut tasks = config.tasks(Split::Training);
    for task in config.tasks(Split::Testing) {
        if !tasks.contains(&task) {
            tasks.push(task);
        }
    }
    let mut all = Vec::new();
    for task in tasks {
        let checked =
            rit_foreign::check(worlds.as_ref(), task, options.episodes.into()).map_err(|broken| {
                let _ = broken.traceback.as_ref().map(|traceback| output::say(&marked(traceback)));
                Failure::runtime_message(format!("the environment breaks a rule: {broken}"))
            })?;
        if !options.json {
            output::print(&in_words(&checked, options.episodes))?;
        }
        all.push(as_json(&checked));
    }
    if options.json {
        output::print(&format!("{:#}\n", json!({ "tasks": all })))?;
    }
    Ok(ExitCode::SUCCESS)
}

fn in_words(checked: &Checked, episodes: u32) -> String {
    let Checked { task, spec, steps, mean_return, is_reproducible, duration } = checked;
    let reproducible = if *is_reproducible {
        "the same seed gives the same episode"
    } else {
        "the same seed does NOT give the same episode: runs with it cannot be repeated"
    };
    // Each episode was rolled three times.
    let rate = 3.0 * *steps as f64 / duration.as_secs_f64();
    format!(
        "{task}: {} agents, {} entities, {} features, {} actions, at most {} steps\n  {episodes} episodes of {:.1} steps, \
         mean return {mean_return:.2} of random actions, {} steps a second\n  {reproducible}\n",
        spec.n_agents,
        spec.n_entities,
        spec.feature_dim,
        spec.n_actions,
        spec.steps_max,
        *steps as f64 / f64::from(episodes),
        report::grouped(rate as u64),
    )
}

fn as_json(checked: &Checked) -> serde_json::Value {
    json!({
        "task": checked.task,
        "n_agents": checked.spec.n_agents,
        "n_entities": checked.spec.n_entities,
        "n_features": checked.spec.feature_dim,
        "n_actions": checked.spec.n_actions,
        "steps_max": checked.spec.steps_max,
        "steps": checked.steps,
        "mean_return": checked.mean_return,
        "is_reproducible": checked.is_reproducible,
        "seconds": checked.duration.as_secs_f64(),
    })
}
