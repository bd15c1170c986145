//! The file of a sweep: what is compared with what.

use crate::failure::Failure;
use rit_config::read_text;
use serde::Deserialize;
use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};
use toml::{Table, Value};

/// What a cell's experiment is called among the axes.
pub const EXPERIMENT: &str = "experiment";
/// What a cell's seed is called where cells are chosen.
pub const SEED: &str = "seed";

/// A sweep, as a person writes it down.
#[derive(Debug)]
pub struct SweepFile {
    /// Where it lies: files that it names are relative to its folder.
    pub folder: PathBuf,
    /// The experiment that all cells begin from, unless there is an axis of experiments.
    pub experiment: Option<String>,
    pub seeds: Vec<u64>,
    /// Every combination of the values of one of these is a cell: `[axes]`, then each `[[also]]`.
    pub grids: Vec<Axes>,
    /// What every cell sets.
    pub set: Settings,
    /// Cells of these values are left out.
    pub exclude: Vec<Settings>,
    pub overrides: Vec<Override>,
}

/// Keys with their values, in the order of the keys' names.
pub type Axes = Vec<(String, Vec<Value>)>;

/// Values by key, such as `algorithm.name`.
pub type Settings = BTreeMap<String, Value>;

/// What cells set beyond the others.
#[derive(Debug)]
pub struct Override {
    /// Which cells: those that have all of these values.
    pub matching: Settings,
    /// What they set.
    pub set: Settings,
}

/// The file's keys.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Typed {
    experiment: Option<String>,
    #[serde(default)]
    seeds: Vec<i64>,
    #[serde(default)]
    axes: Table,
    #[serde(default)]
    also: Vec<Table>,
    #[serde(default)]
    set: Table,
    #[serde(default)]
    exclude: Vec<Table>,
    #[serde(default, rename = "override")]
    overrides: Vec<TypedOverride>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct TypedOverride {
    #[serde(rename = "where")]
    matching: Table,
    set: Table,
}

impl SweepFile {
    /// Reads a file.
    ///
    /// # Errors
    /// When it cannot be read, is no TOML, or says what no sweep has.
    pub fn read(path: &Path) -> Result<Self, Failure> {
        let named = |what: String| Failure::input_message(format!("{}: {what}", path.display()));
        let text = read_text(path).map_err(|error| named(error.to_string()))?;
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        Self::parse(&text, folder.unwrap_or(Path::new("."))).map_err(named)
    }

    fn parse(text: &str, folder: &Path) -> Result<Self, String> {
        let typed: Typed = toml::from_str(text).map_err(|error| wrong_toml(text, &error))?;
        let mut grids = Vec::new();
        // Without axes there is one cell, unless there are others.
        let first = (!typed.axes.is_empty() || typed.also.is_empty()).then_some(typed.axes);
        for table in first.into_iter().chain(typed.also) {
            let axes = flat(table).into_iter().map(|(key, values)| Ok((key.clone(), axis(&key, values)?)));
            grids.push(axes.collect::<Result<Axes, String>>()?);
        }
        let file = Self {
            folder: folder.to_owned(),
            experiment: typed.experiment,
            seeds: seeds(&typed.seeds)?,
            grids,
            set: flat(typed.set),
            exclude: typed.exclude.into_iter().map(flat).collect(),
            overrides: typed
                .overrides
                .into_iter()
                .map(|it| Override { matching: flat(it.matching), set: flat(it.set) })
                .collect(),
        };
        file.check()?;
        Ok(file)
    }

    fn axes(&self) -> impl Iterator<Item = &(String, Vec<Value>)> {
        self.grids.iter().flatten()
    }

    /// The keys that cells differ in, each once.
    pub fn keys(&self) -> Vec<String> {
        let mut keys: Vec<String> = self.axes().map(|(key, _)| key.clone()).collect();
        keys.sort();
        keys.dedup();
        keys
    }

    /// Whether its parts go together.
    fn check(&self) -> Result<(), String> {
        let has_axis = |key: &str| self.axes().any(|(axis, _)| axis == key);
        let names_one = |axes: &Axes| axes.iter().any(|(key, _)| key == EXPERIMENT);
        if self.experiment.is_none() && !self.grids.iter().all(names_one) {
            return Err(
                "it names no experiment; write experiment = \"matrix-game\" (`rit experiments` lists them)"
                    .into(),
            );
        }
        if self.experiment.is_some() && has_axis(EXPERIMENT) {
            return Err("it has an experiment and an axis of experiments; one will do".into());
        }
        let sets = std::iter::once(&self.set).chain(self.overrides.iter().map(|it| &it.set));
        for key in sets.flat_map(BTreeMap::keys).chain(self.axes().map(|(key, _)| key)) {
            if key == SEED {
                return Err("seeds are given by seeds = [1, 2, 3]: each is run once".into());
            }
        }
        if self.set.contains_key(EXPERIMENT)
            || self.overrides.iter().any(|it| it.set.contains_key(EXPERIMENT))
        {
            return Err("experiment is set at the top of the file or is an axis".into());
        }
        if let Some(key) = self.set.keys().find(|key| has_axis(key)) {
            return Err(format!("{key} is an axis and is set for every cell; one will do"));
        }
        for (key, value) in self.exclude.iter().chain(self.overrides.iter().map(|it| &it.matching)).flatten()
        {
            self.check_choice(key, value)?;
        }
        if self.exclude.iter().chain(self.overrides.iter().map(|it| &it.matching)).any(BTreeMap::is_empty) {
            return Err("an exclusion or an override that chooses nothing would mean every cell".into());
        }
        Ok(())
    }

    /// A choice of cells must be able to choose some: a mistyped one would pass unseen.
    fn check_choice(&self, key: &str, value: &Value) -> Result<(), String> {
        let of_axes = self.axes().filter(|(axis, _)| axis == key).flat_map(|(_, values)| values.clone());
        let mut known: Vec<Value> = of_axes.collect();
        if known.is_empty() && key == SEED {
            known.extend(self.seeds.iter().map(|&seed| Value::Integer(seed as i64)));
        }
        if known.is_empty() {
            let axes = self.keys().into_iter().chain([SEED.to_owned()]).collect::<Vec<_>>().join(", ");
            return Err(format!("cells are chosen by {key}, which is no axis; the axes are {axes}"));
        }
        if known.contains(value) {
            return Ok(());
        }
        let known = known.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
        Err(format!("cells are chosen by {key} = {value}, which none of them has; there are {known}"))
    }
}

/// Values of nested tables under the keys' whole names.
fn flat(table: Table) -> Settings {
    fn take(prefix: &str, table: Table, into: &mut Settings) {
        for (key, value) in table {
            let key = format!("{prefix}{key}");
            match value {
                Value::Table(table) => take(&format!("{key}."), table, into),
                value => {
                    into.insert(key, value);
                }
            }
        }
    }
    let mut settings = Settings::new();
    take("", table, &mut settings);
    settings
}

fn axis(key: &str, values: Value) -> Result<Vec<Value>, String> {
    let Value::Array(values) = values else {
        return Err(format!("the axis {key} is no list; write {key} = [{values}], or set it under [set]"));
    };
    if values.is_empty() {
        return Err(format!("the axis {key} has no values: there would be no cell"));
    }
    if let Some(twice) = values.iter().enumerate().find(|(at, value)| values[..*at].contains(value)) {
        return Err(format!("the axis {key} has {} twice: one run would be made again", twice.1));
    }
    Ok(values)
}

fn seeds(typed: &[i64]) -> Result<Vec<u64>, String> {
    let mut seeds: Vec<u64> = Vec::new();
    for &seed in typed {
        let seed = u64::try_from(seed).map_err(|_| format!("the seed {seed} is below 0"))?;
        if seeds.contains(&seed) {
            return Err(format!("the seed {seed} is there twice: one run would be made again"));
        }
        seeds.push(seed);
    }
    if seeds.is_empty() {
        return Err("it has no seeds; write seeds = [1, 2, 3]".into());
    }
    Ok(seeds)
}

/// What is wrong with the text, on one line and with its place.
fn wrong_toml(text: &str, error: &toml::de::Error) -> String {
    let before = error.span().and_then(|span| text.get(..span.start)).unwrap_or_default();
    let line = before.matches('\n').count() + 1;
    let reason = error.message().lines().collect::<Vec<_>>().join("; ");
    format!("line {line}: {reason}")
}

#[cfg(test)]
mod tests {
    use super::*;

    const WHOLE: &str = r#"
        experiment = "matrix-game"
        seeds = [1, 2, 3]
        [axes]
        "algorithm.name" = ["rit", "vdn-attn"]
        algorithm.gamma = [0.9, 0.99]
        [set]
        "training.t_max" = 4000
        learner.tls.key = "a"
        [[exclude]]
        "algorithm.name" = "vdn-attn"
        seed = 3
        [[override]]
        where = { "algorithm.name" = "rit" }
        set = { "algorithm.lr" = 0.001 }
    "#;

    fn parse(text: &str) -> Result<SweepFile, String> {
        SweepFile::parse(text, Path::new("."))
    }

    #[test]
    fn keys_may_be_written_either_way() {
        let file = parse(WHOLE).unwrap();
        let axes: Vec<_> = file.grids[0].iter().map(|(key, values)| (key.as_str(), values.len())).collect();
        assert_eq!(axes, [("algorithm.gamma", 2), ("algorithm.name", 2)]);
        assert_eq!(file.set.keys().collect::<Vec<_>>(), ["learner.tls.key", "training.t_max"]);
        assert_eq!((file.exclude[0].len(), file.overrides[0].set.len()), (2, 1));
    }

    #[test]
    fn what_is_no_sweep_is_said_plainly() {
        for (from, to, message) in [
            ("experiment = \"matrix-game\"", "", "it names no experiment; write experiment = "),
            ("seeds = [1, 2, 3]", "", "it has no seeds"),
            ("[1, 2, 3]", "[1, 2, 1]", "the seed 1 is there twice"),
            ("[1, 2, 3]", "[-1, 3]", "the seed -1 is below 0"),
            ("[0.9, 0.99]", "[]", "the axis algorithm.gamma has no values"),
            ("[0.9, 0.99]", "0.9", "the axis algorithm.gamma is no list; write algorithm.gamma = [0.9]"),
            ("[0.9, 0.99]", "[0.9, 0.9]", "the axis algorithm.gamma has 0.9 twice"),
            ("algorithm.gamma = [0.9, 0.99]", "seed = [1]", "seeds are given by seeds = [1, 2, 3]"),
            ("algorithm.gamma = [0.9, 0.99]", "experiment = [\"a\"]", "an axis of experiments; one will do"),
            ("\"training.t_max\" = 4000", "algorithm.gamma = 0.5", "algorithm.gamma is an axis and is set"),
            (
                "\"vdn-attn\"\n        seed",
                "\"vdn\"\n        seed",
                "algorithm.name = \"vdn\", which none of them has",
            ),
            (
                "        seed = 3",
                "        algorithm.lr = 3",
                "chosen by algorithm.lr, which is no axis; the axes are",
            ),
            ("[[exclude]]", "[[exclude]]\n[[exclude]]", "chooses nothing would mean every cell"),
            ("[axes]", "[axis]", "line 4: unknown field `axis`, expected one of `experiment`, `seeds`"),
            ("seeds = [", "seeds = [[", "line 4: missing comma"),
        ] {
            assert!(WHOLE.contains(from), "{from}");
            let refused = parse(&WHOLE.replacen(from, to, 1)).unwrap_err();
            assert!(refused.contains(message) && !refused.contains('\n'), "{refused}");
        }
    }
}
