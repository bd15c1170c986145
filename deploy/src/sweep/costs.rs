//! What environment steps cost, by what finished runs took.

use super::standing::{Standing, State};
use rit_config::{Config, family};
use rit_env::TaskSet;
use rit_record::{Cell, Record, Sweep};
use std::collections::BTreeMap;

/// Kinds of runs that are alike, the most alike first: by all settings but the seed, by task set and algorithm, by the task
/// set's family and algorithm, by task set, by family.
const KINDS: usize = 5;
/// Beyond this kind a cost is another method's or another task set's.
const OWN: usize = 1;

/// CPU seconds of an environment step in finished runs, by kind and key.
#[derive(Default)]
pub struct Costs([BTreeMap<String, Vec<f64>>; KINDS]);

/// What a step of a cell will cost.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cost {
    pub cpu_s: f64,
    /// Whether runs of another method or task set have shown it.
    pub is_rough: bool,
}

fn keys(exact: String, task_set: TaskSet, algorithm: &str) -> [String; KINDS] {
    let family = family(task_set);
    [
        exact,
        format!("{task_set} {algorithm}"),
        format!("{family} {algorithm}"),
        task_set.to_string(),
        family.to_owned(),
    ]
}

fn keys_of_cell(cell: &Cell, config: &Config) -> [String; KINDS] {
    let exact = format!("{} {:?}", cell.experiment, cell.settings);
    keys(exact, config.environment.task_set, &config.algorithm.name.to_string())
}

impl Costs {
    /// Of the cells that are finished.
    pub fn of(sweep: &Sweep, configs: &[Config], standings: &[Standing]) -> Self {
        let mut costs = Self::default();
        for ((cell, config), standing) in sweep.cells.iter().zip(configs).zip(standings) {
            if standing.state == State::Finished {
                costs.add(keys_of_cell(cell, config), standing.cpu_s, standing.env_steps);
            }
        }
        costs
    }

    /// Adds what finished runs took that are no cells.
    pub fn add_records(&mut self, records: &[Record]) {
        for record in records.iter().filter(|record| record.is_whole()) {
            let task_set = record.task_set().and_then(|task_set| task_set.parse::<TaskSet>().ok());
            if let (Some(task_set), Some(method)) = (task_set, record.method()) {
                self.add(
                    keys(record.name.clone(), task_set, method),
                    record.cpu_s,
                    record.progress.env_steps,
                );
            }
        }
    }

    fn add(&mut self, keys: [String; KINDS], cpu_s: Option<f64>, env_steps: u64) {
        let Some(cpu_s) = cpu_s else { return };
        for (of_kind, key) in self.0.iter_mut().zip(keys) {
            of_kind.entry(key).or_default().push(cpu_s / env_steps.max(1) as f64);
        }
    }

    /// The mean over the runs that are most like this cell.
    pub fn per_step(&self, cell: &Cell, config: &Config) -> Option<Cost> {
        let keys = keys_of_cell(cell, config);
        let found = self.0.iter().zip(&keys).enumerate();
        let (kind, found) =
            found.filter_map(|(kind, (of_kind, key))| Some((kind, of_kind.get(key)?))).next()?;
        Some(Cost { cpu_s: rit_statistics::mean(found), is_rough: kind > OWN })
    }
}
