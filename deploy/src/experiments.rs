//! The experiments that come with the program, and a person's own.

use crate::{cli::ConfigOptions, failure::Failure, output, python_worlds};
use rit_algo::Method;
use rit_config::{Config, in_program_words, read_text, resolve, set, set_all};
use std::{collections::BTreeMap, path::Path, process::ExitCode};
use toml::Table;

/// Name and text of each, from `deploy/experiments/`.
const EXPERIMENTS: [(&str, &str); 11] = [
    ("matrix-game", include_str!("../experiments/matrix-game.toml")),
    ("matrix-game-vdn", include_str!("../experiments/matrix-game-vdn.toml")),
    (
        "matrix-game-no-task-representations",
        include_str!("../experiments/matrix-game-no-task-representations.toml"),
    ),
    (
        "matrix-game-no-random-permutation",
        include_str!("../experiments/matrix-game-no-random-permutation.toml"),
    ),
    ("cooperative-navigation", include_str!("../experiments/cooperative-navigation.toml")),
    ("predator-prey", include_str!("../experiments/predator-prey.toml")),
    ("predator-prey-pro", include_str!("../experiments/predator-prey-pro.toml")),
    ("3-8m", include_str!("../experiments/3-8m.toml")),
    ("3-8sz", include_str!("../experiments/3-8sz.toml")),
    ("3-8MMM", include_str!("../experiments/3-8MMM.toml")),
    ("3-8csz", include_str!("../experiments/3-8csz.toml")),
];

/// A resolved experiment and the name a run of it gets.
#[derive(Debug)]
pub struct Experiment {
    /// The experiment's name, or its file's.
    pub name: String,
    /// What it resolves to.
    pub config: Config,
}

/// The settings of `train`'s options, beside `--set`.
pub fn settings(options: &ConfigOptions) -> Vec<String> {
    let mut settings = options.settings.clone();
    settings.extend(algorithm(options.algorithm.as_deref()));
    settings.extend(options.seed.map(|seed| format!("seed={seed}")));
    settings.extend(options.actors.map(|count| format!("actors.count={count}")));
    settings.extend(options.steps.map(|steps| format!("training.t_max={steps}")));
    settings.extend(options.until.as_ref().map(|until| format!("training.until={until:?}")));
    settings
}

/// `--algorithm NAME` as a setting: above what the experiment says and `--set` alike.
pub fn algorithm(name: Option<&str>) -> Option<String> {
    name.map(|name| format!("algorithm.name={name:?}"))
}

/// Resolves an experiment, by name or by file, under these `section.key=value` settings.
///
/// # Errors
/// When there is no such experiment or something in it is wrong.
pub fn load(experiment: &str, settings: &[String]) -> Result<Experiment, Failure> {
    let settings = parse_settings(settings)?;
    if let Some((name, text)) = EXPERIMENTS.iter().find(|(name, _)| *name == experiment) {
        return Ok(Experiment { name: (*name).to_owned(), config: resolve(text, name, &settings)? });
    }
    if let Some(set) = rit_env::registered().into_iter().find(|set| set.to_string() == experiment) {
        let text = format!("environment.task_set = \"{set}\"");
        return Ok(Experiment {
            name: experiment.to_owned(),
            config: resolve(&text, experiment, &settings)?,
        });
    }
    let path = Path::new(experiment);
    if path.extension().is_none_or(|extension| extension != "toml") {
        return Err(unknown(experiment));
    }
    let text = read_text(path).map_err(|error| Failure::input_message(format!("{experiment}: {error}")))?;
    let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    Ok(Experiment { name, config: with_worlds(&text, experiment, settings)? })
}

/// Resolves an experiment's text under these settings.
///
/// # Errors
/// When something in it is wrong.
pub fn resolve_text(text: &str, source_name: &str, settings: &[String]) -> Result<Config, Failure> {
    with_worlds(text, source_name, parse_settings(settings)?)
}

/// Environments in Python are asked what they are.
fn with_worlds(text: &str, source_name: &str, mut settings: Vec<Table>) -> Result<Config, Failure> {
    settings.extend(python_worlds::described(text, source_name, &settings)?);
    Ok(resolve(text, source_name, &settings)?)
}

/// `section.key=value` settings as tables.
///
/// # Errors
/// When one is no assignment.
pub fn parse_settings(settings: &[String]) -> Result<Vec<Table>, Failure> {
    Ok(set_all(settings)?)
}

/// Every setting of a run of the experiment that is called as its task set, with this method and nothing else set: what
/// reports and plots call by the method's plain name. Other task sets have their presets.
pub fn plain_settings(task_set: &str, method: &str) -> Option<BTreeMap<String, String>> {
    let (name, text) = EXPERIMENTS.into_iter().find(|(name, _)| *name == task_set)?;
    let method = set(&algorithm(Some(method))?).ok()?;
    resolve(text, name, &[method]).ok()?.settings().ok()
}

fn unknown(experiment: &str) -> Failure {
    let likeness = |name: &str| strsim::jaro_winkler(experiment, name);
    let own = rit_env::registered().into_iter().map(|set| set.to_string());
    let known = EXPERIMENTS.map(|(name, _)| name.to_owned()).into_iter().chain(own);
    let closest = known.max_by(|a, b| likeness(a).total_cmp(&likeness(b)));
    let hint = closest.filter(|name| likeness(name) > 0.8).map(|name| format!("did you mean {name}? "));
    Failure::input_message(format!(
        "unknown experiment {experiment:?}; {}`rit experiments` lists them, a path ending in .toml is read",
        hint.unwrap_or_default()
    ))
}

/// `rit experiments`.
pub fn print() -> Result<ExitCode, Failure> {
    let experiments = EXPERIMENTS.map(|(name, text)| {
        format!("  {name:38} {}\n", text.lines().next().unwrap_or_default().trim_start_matches("# "))
    });
    let own = rit_env::registered().into_iter();
    let own = own.map(|set| format!("  {:38} this program's own task set\n", set.to_string()));
    let algorithms = Method::ALL.map(Method::facts);
    let algorithms = algorithms.map(|facts| format!("  {:38} {}\n", facts.name, facts.summary));
    output::print(&in_program_words(&format!(
        "experiments: task sets with their settings, `rit train EXPERIMENT`\n{}\nalgorithms: any of them on any task set, \
         `rit train EXPERIMENT --algorithm NAME`\n{}",
        experiments.into_iter().chain(own).collect::<String>(),
        algorithms.concat()
    )))?;
    Ok(ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_experiment_resolves() {
        for (name, _) in EXPERIMENTS {
            assert_eq!(load(name, &[]).unwrap().name, name);
        }
        let files = std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/experiments")).unwrap();
        assert_eq!(files.count(), EXPERIMENTS.len(), "every file is embedded");
    }
}
