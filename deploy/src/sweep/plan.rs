//! From a sweep's file to its cells: every combination of the axes' values with every seed, each resolved once, so that
//! what is wrong is said before anything runs.

use super::file::{EXPERIMENT, SEED, Settings, SweepFile};
use crate::{experiments, failure::Failure};
use rit_config::Config;
use rit_record::{Cell, Sweep};
use std::{collections::BTreeMap, path::Path};
use toml::Value;

/// Longest part of a cell's name that one axis makes.
const PART_CHARS_MAX: usize = 40;

/// A sweep's cells with their configurations, cell by cell.
#[derive(Debug)]
pub struct Plan {
    pub sweep: Sweep,
    pub configs: Vec<Config>,
}

impl Plan {
    /// Of a file.
    ///
    /// # Errors
    /// When a cell's configuration is wrong, no cell is left, or two cells are the same run.
    pub fn new(file: &SweepFile) -> Result<Self, Failure> {
        let (mut cells, mut configs) = (Vec::new(), Vec::new());
        // Seed by seed: at every moment, methods have about as many runs each.
        for &seed in &file.seeds {
            for values in file.grids.iter().flat_map(|axes| combinations(axes)) {
                let Some(cell) = cell(file, &values, seed) else { continue };
                configs.push(resolve(&cell)?);
                cells.push(cell);
            }
        }
        if cells.is_empty() {
            return Err(Failure::input_message("every cell of the sweep is excluded"));
        }
        refuse_same(&cells, &configs)?;
        name_apart(&mut cells);
        Ok(Self { sweep: Sweep::new(file.keys(), cells), configs })
    }
}

/// The settings of a cell as they are typed after `--set`.
pub fn arguments(cell: &Cell) -> Vec<String> {
    let settings = cell.settings.iter().map(|(key, value)| format!("{key}={value}"));
    settings.chain([format!("{SEED}={}", cell.seed)]).collect()
}

/// What a cell's run is made from.
///
/// # Errors
/// When its configuration is wrong.
pub fn resolve(cell: &Cell) -> Result<Config, Failure> {
    let loaded = experiments::load(&cell.experiment, &arguments(cell));
    let named = |failure: Failure| Failure::input_message(format!("{}: {failure}", cell.name));
    Ok(loaded.map_err(named)?.config)
}

/// One value of every axis, the last axis' values changing first.
fn combinations(axes: &[(String, Vec<Value>)]) -> Vec<Settings> {
    let mut all = vec![Settings::new()];
    for (key, values) in axes {
        let with = |before: &Settings| {
            let before = before.clone();
            values.iter().map(move |value| {
                let mut settings = before.clone();
                settings.insert(key.clone(), value.clone());
                settings
            })
        };
        all = all.iter().flat_map(with).collect();
    }
    all
}

/// The cell of these values, unless it is excluded.
fn cell(file: &SweepFile, values: &Settings, seed: u64) -> Option<Cell> {
    let mut choice = values.clone();
    choice.insert(SEED.to_owned(), Value::Integer(seed as i64));
    let matches = |wanted: &Settings| wanted.iter().all(|(key, value)| choice.get(key) == Some(value));
    if file.exclude.iter().any(matches) {
        return None;
    }
    let mut settings = file.set.clone();
    settings.extend(values.clone());
    for it in file.overrides.iter().filter(|it| matches(&it.matching)) {
        settings.extend(it.set.clone());
    }
    let of_axis = settings.remove(EXPERIMENT).and_then(|value| value.as_str().map(str::to_owned));
    let experiment = of_axis.or_else(|| file.experiment.clone()).unwrap_or_default();
    let mut parts: Vec<String> = values.iter().map(|(key, value)| part(key, value)).collect();
    parts.push(format!("{SEED}-{seed}"));
    let settings = settings.into_iter().map(|(key, value)| (key, value.to_string())).collect();
    let experiment = found(&experiment, &file.folder);
    Some(Cell { name: parts.join("_"), experiment, seed, settings })
}

/// A file's path is relative to the sweep's.
fn found(experiment: &str, folder: &Path) -> String {
    let path = Path::new(experiment);
    if path.extension().is_some_and(|extension| extension == "toml") {
        let path = folder.join(path);
        // As it is typed: a file of a ConfigMap is a link, which leads elsewhere tomorrow.
        return std::path::absolute(&path).unwrap_or(path).display().to_string();
    }
    experiment.to_owned()
}

/// What a name says of one axis: `vdn-attn`, `gamma-0.9`.
fn part(key: &str, value: &Value) -> String {
    let word = match value {
        Value::String(text) if key == EXPERIMENT => {
            Path::new(text).file_stem().unwrap_or_default().to_string_lossy().into_owned()
        }
        Value::String(text) => text.clone(),
        value => value.to_string(),
    };
    let name = key.rsplit('.').next().unwrap_or(key);
    let speaks_for_itself = [EXPERIMENT, "algorithm.name", "environment.task_set"].contains(&key);
    let text = if speaks_for_itself { word } else { format!("{name}-{word}") };
    let plain = |c: char| if c.is_ascii_alphanumeric() || "-+.".contains(c) { c } else { '-' };
    let text: String = text.chars().map(plain).take(PART_CHARS_MAX).collect();
    text.split('-').filter(|word| !word.is_empty()).collect::<Vec<_>>().join("-")
}

/// Names that came out the same get a number.
fn name_apart(cells: &mut [Cell]) {
    let mut seen: BTreeMap<String, usize> = BTreeMap::new();
    for cell in cells {
        let times = seen.entry(cell.name.clone()).or_default();
        *times += 1;
        if *times > 1 {
            cell.name = format!("{}_{times}", cell.name);
        }
    }
}

/// Refuses two cells whose runs would be one.
fn refuse_same(cells: &[Cell], configs: &[Config]) -> Result<(), Failure> {
    for (at, config) in configs.iter().enumerate() {
        if let Some(same) = configs[..at].iter().position(|other| other == config) {
            return Err(Failure::input_message(format!(
                "{} and {} are the same run: all their settings are the same, an override or an axis without effect \
                 makes them so",
                cells[same].name, cells[at].name
            )));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_algo::Regime;

    fn plan(text: &str) -> Result<Plan, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("sweep.toml");
        std::fs::write(&path, text).unwrap();
        let planned = SweepFile::read(&path).and_then(|file| Plan::new(&file));
        planned.map_err(|failure| failure.to_string())
    }

    fn names(plan: &Plan) -> Vec<&str> {
        plan.sweep.cells.iter().map(|cell| cell.name.as_str()).collect()
    }

    #[test]
    fn every_combination_is_a_cell_with_a_name_that_says_what_it_is() {
        let plan = plan(
            "experiment = 'matrix-game'\nseeds = [1, 2]\n[axes]\n'algorithm.name' = ['rit', 'vdn-attn']\n\
             'algorithm.gamma' = [0.9, 1]\n[set]\n'training.t_max' = 4000\n[[exclude]]\nseed = 2\n\
             'algorithm.name' = 'rit'\n[[override]]\nwhere = { 'algorithm.name' = 'vdn-attn' }\n\
             set = { 'algorithm.lr' = 0.25 }",
        )
        .unwrap();
        assert_eq!(
            names(&plan),
            [
                "gamma-0.9_rit_seed-1",
                "gamma-0.9_vdn-attn_seed-1",
                "gamma-1_rit_seed-1",
                "gamma-1_vdn-attn_seed-1",
                "gamma-0.9_vdn-attn_seed-2",
                "gamma-1_vdn-attn_seed-2",
            ]
        );
        let facts = |at: usize| {
            let config = &plan.configs[at];
            (config.seed.0, config.algorithm.gamma, config.algorithm.lr, config.training.t_max)
        };
        assert_eq!((facts(0), facts(5)), ((1, 0.9, 5e-4, 4000), (2, 1.0, 0.25, 4000)));
        assert_eq!(plan.sweep.cells[5].settings["algorithm.name"], "\"vdn-attn\"");
    }

    #[test]
    fn experiments_and_task_sets_may_be_axes() {
        let plan = plan("seeds = [1]\n[axes]\nexperiment = ['matrix-game', 'predator-prey']").unwrap();
        assert_eq!(names(&plan), ["matrix-game_seed-1", "predator-prey_seed-1"]);
        assert_eq!((plan.configs[0].algorithm.gamma, plan.configs[1].algorithm.gamma), (0.99, 0.8));
    }

    #[test]
    fn other_combinations_may_be_run_beside_those_of_the_axes() {
        let plan = plan(
            "seeds = [1]\n[axes]\nexperiment = ['3-8m', 'matrix-game']\n'algorithm.name' = ['rit', 'mat']\n[[also]]\n\
             experiment = ['3-8m']\n'algorithm.random_permutation' = [false]\n[[override]]\nwhere = { \
             'algorithm.random_permutation' = false }\nset = { 'algorithm.lr' = 0.25 }",
        )
        .unwrap();
        assert_eq!(
            names(&plan),
            [
                "rit_3-8m_seed-1",
                "rit_matrix-game_seed-1",
                "mat_3-8m_seed-1",
                "mat_matrix-game_seed-1",
                "random-permutation-false_3-8m_seed-1",
            ]
        );
        let last = &plan.configs[4].algorithm;
        assert_eq!((last.name.to_string(), last.random_permutation, last.lr), ("rit".into(), false, 0.25));
        assert_eq!(plan.sweep.axes, ["algorithm.name", "algorithm.random_permutation", "experiment"]);
    }

    /// Table II for every cell; figures 2 to 5 and tables III to V are made of these.
    #[test]
    fn the_papers_comparison_is_whole() {
        let path = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/results/paper.toml"));
        let plan = SweepFile::read(path).and_then(|file| Plan::new(&file)).unwrap();
        let of_cell = |config: &Config| {
            let (algorithm, environment) = (&config.algorithm, &config.environment);
            let single = environment.training_tasks.len() == 1;
            let without = !algorithm.random_permutation && algorithm.name.facts().regime == Regime::Replay;
            let order = if without { "-no-random-permutation" } else { "" };
            (format!("{}{order}", algorithm.name), environment.task_set.to_string(), single)
        };
        let mut counts: BTreeMap<_, usize> = BTreeMap::new();
        for config in &plan.configs {
            *counts.entry(of_cell(config)).or_default() += 1;
            assert_eq!((config.algorithm.gamma, config.environment.approach_shaping), (0.99, 0.0));
        }
        let count = |method: &str, task_set: &str, single| {
            counts.get(&(method.to_owned(), task_set.to_owned(), single)).copied().unwrap_or(0)
        };
        let sets = ["matrix-game", "predator-prey", "predator-prey-pro", "3-8m"];
        let ablated = ["cooperative-navigation", "3-8sz", "3-8MMM", "3-8csz"];
        for task_set in sets.into_iter().chain(ablated) {
            for method in [
                "rit",
                "rit-vdn",
                "refil",
                "updet-mix",
                "updet-vdn",
                "qmix-attn",
                "vdn-attn",
                "roma",
                "mappo",
                "mat",
            ] {
                assert_eq!(count(method, task_set, false), 5, "{method} {task_set}");
            }
        }
        for task_set in ablated {
            for method in ["rit-no-random-permutation", "rit-no-task-representations"] {
                assert_eq!(count(method, task_set, false), 5, "{method} {task_set}");
            }
        }
        // Two maps of each set, five seeds.
        for task_set in ["3-8m", "3-8sz", "3-8MMM", "3-8csz"] {
            for method in ["qmix-int", "vdn-int"]
                .iter()
                .flat_map(|it| [it.to_string(), format!("{it}-no-random-permutation")])
            {
                assert_eq!(count(&method, task_set, true), 10, "{method} {task_set}");
            }
        }
        assert_eq!(plan.configs.len(), 600);
    }

    #[test]
    fn lists_and_strange_values_make_names_all_the_same() {
        let plan = plan(
            "experiment = 'matrix-game'\nseeds = [1]\n[axes]\n'environment.training_tasks' = [['game-1', 'game-2'], \
             ['game-1'], []]",
        )
        .unwrap();
        assert_eq!(
            names(&plan),
            ["training-tasks-game-1-game-2_seed-1", "training-tasks-game-1_seed-1", "training-tasks_seed-1"]
        );
    }

    #[test]
    fn what_is_wrong_with_a_cell_is_said_before_anything_runs() {
        let refused = |axes: &str| {
            plan(&format!("experiment = 'matrix-game'\nseeds = [1]\n[axes]\n{axes}")).unwrap_err()
        };
        assert!(refused("'algorithm.gama' = [0.9]").contains("did you mean algorithm.gamma?"));
        assert!(
            refused("'algorithm.gamma' = [7]")
                .contains("gamma-7_seed-1: algorithm.gamma = 7 is out of range")
        );
        assert!(refused("'algorithm.name' = ['rit', 'dqn']").contains("unknown algorithm \"dqn\""));
        let same = refused(
            "'algorithm.gamma' = [0.9, 1]\n[[override]]\nwhere = { 'algorithm.gamma' = 1 }\nset = { 'algorithm.gamma' = 0.9 }",
        );
        assert!(same.starts_with("gamma-0.9_seed-1 and gamma-1_seed-1 are the same run"), "{same}");
        let all = plan("experiment = 'matrix-game'\nseeds = [1]\n[[exclude]]\nseed = 1").unwrap_err();
        assert_eq!(all, "every cell of the sweep is excluded");
        let unknown = plan("experiment = 'matrix'\nseeds = [1]").unwrap_err();
        assert!(unknown.contains("unknown experiment \"matrix\""), "{unknown}");
    }
}
