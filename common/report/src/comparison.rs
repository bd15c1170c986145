//! Which runs belong together: task sets, the methods on each, and the seeds of each method.

use crate::{ReportError, error::OtherKind, measure::Measure, paper};
use rit_algo::Regime;
use rit_config::preset_settings;
use rit_env::{Split, TaskSet};
use rit_record::Record;
use std::collections::{BTreeMap, BTreeSet};

/// How often the training tasks are evaluated.
const INTERVAL: &str = "evaluation.every_env_steps";
/// How many environment steps a run takes.
const LENGTH: &str = "training.t_max";
/// What tells methods apart beside `algorithm.name`.
const PERMUTATION: &str = "algorithm.random_permutation";
/// What is added to the name of a method without it, as in the paper.
pub const NO_PERMUTATION: &str = "-no-random-permutation";

/// What is compared, and how.
#[derive(Clone, Debug)]
pub struct Options {
    /// In place of what the paper compares on each task set.
    pub measure: Option<Measure>,
    /// Keys whose values make methods of their own.
    pub by: Vec<String>,
    /// Pairs of methods whose probability of improvement is said; of none given, the first against every other.
    pub pairs: Vec<(String, String)>,
    /// Replications of the bootstrap.
    pub replications: usize,
    /// Of the bootstrap and of maps.
    pub seed: u64,
    /// What a method's plain name means on a task set: every setting of a run for which nothing else is set.
    pub plain: fn(&str, &str) -> Option<Settings>,
}

/// Every `section.key` with its value.
pub type Settings = BTreeMap<String, String>;

/// What the presets say of a task set and a method: the paper's tables, as far as it has them.
pub(crate) fn of_presets(task_set: &str, method: &str) -> Option<Settings> {
    preset_settings(task_set, method).ok()
}

impl Default for Options {
    fn default() -> Self {
        let (measure, by, pairs) = (None, Vec::new(), Vec::new());
        Self { measure, by, pairs, replications: 50_000, seed: 1, plain: of_presets }
    }
}

/// Runs of several methods on the same tasks.
#[derive(Clone, Debug)]
pub struct Group {
    /// For people, such as "Cooperative navigation".
    pub title: String,
    /// The same as part of a file's name.
    pub id: String,
    /// In configuration.
    pub task_set: String,
    /// What is compared.
    pub measure: Measure,
    /// The paper's methods in the paper's order, then others.
    pub methods: Vec<Method>,
    /// The tasks of one split that every run was evaluated on.
    pub training: Vec<String>,
    /// Likewise.
    pub testing: Vec<String>,
}

/// Runs that differ in their seed alone.
#[derive(Clone, Debug)]
pub struct Method {
    /// Its name, and what else sets it apart.
    pub label: String,
    /// In the order of their seeds; at least one.
    pub runs: Vec<Record>,
}

impl Method {
    /// Whether something else was set than what its plain name means: the label says what, after a space.
    pub fn is_variant(&self) -> bool {
        self.label.contains(' ')
    }

    /// Whether there are seeds enough for an interval.
    pub fn is_reliable(&self) -> bool {
        self.runs.len() >= rit_statistics::SEEDS_MIN
    }
}

impl Group {
    /// Its tasks of one split.
    pub fn tasks(&self, split: Split) -> &[String] {
        match split {
            Split::Training => &self.training,
            Split::Testing => &self.testing,
        }
    }

    /// What each run of a method came to over the tasks of a split.
    pub fn scores(&self, method: &Method, split: Split) -> Vec<f64> {
        let tasks = self.tasks(split);
        method.runs.iter().filter_map(|run| self.measure.over_tasks(run, split, tasks)).collect()
    }

    /// What each run of a method came to on a task.
    pub fn scores_of_task(&self, method: &Method, split: Split, task: &str) -> Vec<f64> {
        method.runs.iter().filter_map(|run| self.measure.at_the_end(run, split, task)).collect()
    }

    /// A method's learning curve, at the environment steps at which each of its runs was evaluated: each run's value, the
    /// mean over tasks.
    pub fn curve(&self, method: &Method, split: Split) -> Vec<(u64, Vec<f64>)> {
        let curves: Vec<_> = self.curves(method, split);
        let Some((first, rest)) = curves.split_first() else { return Vec::new() };
        let steps = first.keys().filter(|step| rest.iter().all(|curve| curve.contains_key(step)));
        let values = |step: &u64| curves.iter().map(|curve| rit_statistics::mean(&curve[step])).collect();
        steps.map(|step| (*step, values(step))).collect()
    }

    /// Each run's curve, task by task.
    pub fn curves(&self, method: &Method, split: Split) -> Vec<BTreeMap<u64, Vec<f64>>> {
        let tasks = self.tasks(split);
        if tasks.is_empty() {
            return Vec::new();
        }
        method.runs.iter().map(|run| self.measure.curve(run, split, tasks)).collect()
    }

    /// The fewest seeds of any method.
    pub fn seeds_min(&self) -> usize {
        self.methods.iter().map(|method| method.runs.len()).min().unwrap_or(0)
    }
}

/// Puts finished runs together.
///
/// # Errors
/// When runs cannot be averaged or compared, or have not measured what is asked for.
pub fn groups(runs: Vec<Record>, options: &Options) -> Result<Vec<Group>, ReportError> {
    if let Some(key) = options.by.iter().find(|key| !runs.iter().any(|run| value(run, key).is_some())) {
        return Err(ReportError::By(key.clone()));
    }
    let mut of_tasks: BTreeMap<(usize, String, Vec<String>), Vec<Record>> = BTreeMap::new();
    for run in runs {
        let training = names(&run, Split::Training);
        let task_set = task_set(&run, &training);
        of_tasks.entry((paper::place(&task_set), task_set, training)).or_default().push(run);
    }
    let several = |task_set: &str| of_tasks.keys().filter(|(_, other, _)| other == task_set).count() > 1;
    let several: BTreeSet<String> =
        of_tasks.keys().filter(|(_, name, _)| several(name)).map(|(_, name, _)| name.clone()).collect();
    let groups = of_tasks.into_iter().map(|((_, task_set, training), runs)| {
        let whole = is_whole(&task_set, &training);
        let named = several.contains(&task_set) || !whole;
        group(task_set, training, named, runs, options)
    });
    groups.collect()
}

fn group(
    task_set: String,
    training: Vec<String>,
    named: bool,
    runs: Vec<Record>,
    options: &Options,
) -> Result<Group, ReportError> {
    let measure = options.measure.unwrap_or_else(|| Measure::of_task_set(&task_set));
    refuse_other_versions(&runs)?;
    let methods = methods(&task_set, runs, options)?;
    refuse_other_intervals(&methods)?;
    let mut title = paper::title(&task_set);
    let mut id = task_set.to_lowercase();
    if named {
        title += &format!(": {}", training.join(", "));
        id = format!("{id}-{}", training.join("-").to_lowercase());
        id.truncate(80);
    }
    let all_runs = || methods.iter().flat_map(|method| &method.runs);
    for (run, task) in all_runs().flat_map(|run| training.iter().map(move |task| (run, task))) {
        if measure.at_the_end(run, Split::Training, task).is_none() {
            let (run, task) = (run.name.clone(), task.clone());
            return Err(ReportError::Missing { run, what: measure.words().to_owned(), task });
        }
    }
    let tested =
        |task: &String| all_runs().all(|run| measure.at_the_end(run, Split::Testing, task).is_some());
    let testing: BTreeSet<String> = all_runs().flat_map(|run| names(run, Split::Testing)).collect();
    let testing = in_order(&task_set, Split::Testing, testing.into_iter().filter(tested).collect());
    let training = in_order(&task_set, Split::Training, training);
    Ok(Group { title, id, task_set, measure, methods, training, testing })
}

/// Runs by what they are called.
fn methods(task_set: &str, runs: Vec<Record>, options: &Options) -> Result<Vec<Method>, ReportError> {
    let mut methods: Vec<Method> = Vec::new();
    for run in runs {
        let label = label(&run, task_set, options);
        let Some(method) = methods.iter_mut().find(|method| method.label == label) else {
            methods.push(Method { label, runs: vec![run] });
            continue;
        };
        for other in &method.runs {
            refuse_same(other, &run)?;
        }
        refuse_other_kind(&method.runs[0], &run, &label, task_set)?;
        method.runs.push(run);
    }
    methods.iter_mut().for_each(|method| method.runs.sort_by_key(|run| run.seed));
    methods.sort_by_key(|method| (paper::method_place(&method.label), method.label.clone()));
    Ok(methods)
}

fn value<'a>(run: &'a Record, key: &str) -> Option<&'a String> {
    run.settings.get(key).or_else(|| run.kind.get(key))
}

/// The method's name, and what sets it apart from others of that name.
fn label(run: &Record, task_set: &str, options: &Options) -> String {
    let mut label = run.method().map_or_else(|| older(run, task_set), str::to_owned);
    if run.settings.get(PERMUTATION).is_some_and(|value| value == "false") && is_permuted(&label) {
        label += NO_PERMUTATION;
    }
    let plain = (options.plain)(task_set, run.method().unwrap_or("rit")).unwrap_or_default();
    for key in &options.by {
        let word = key.rsplit('.').next().unwrap_or(key);
        match value(run, key) {
            // It is the label already, or its values are in the label.
            Some(value) if *value == label => {}
            // Runs that change nothing are what the method's plain name means.
            Some(value) if plain.get(key) == Some(value) => {}
            _ if ["algorithm.name", PERMUTATION].contains(&key.as_str()) => {}
            Some(value) if word == "folder" => label += &format!(" {value}"),
            Some(value) => label += &format!(" {word}={value}"),
            None => {}
        }
    }
    // marl-eval takes no comma in a name.
    label.replace(',', ";")
}

/// Whether a method permutes the decision order unless something else is said: those of actor and critic do not.
fn is_permuted(method: &str) -> bool {
    let all = rit_algo::Method::ALL.into_iter().map(rit_algo::Method::facts);
    let found = all.into_iter().find(|facts| facts.name == method);
    found.is_none_or(|facts| facts.regime == Regime::Replay)
}

/// A record without settings is of a build that had RIT alone; what its folder's name adds to the task set's is what was
/// set: "rit gamma-0.8" of `cooperative-navigation-gamma-0.8`.
fn older(run: &Record, task_set: &str) -> String {
    let set = run.folder.strip_prefix(task_set).map(|rest| rest.trim_start_matches('-'));
    match set {
        Some("") => "rit".to_owned(),
        Some(set) => format!("rit {set}"),
        None => run.folder.clone(),
    }
}

fn refuse_same(first: &Record, second: &Record) -> Result<(), ReportError> {
    let same_seed = first.seed.is_some() && first.seed == second.seed && first.kind == second.kind;
    let digests = (&first.weights_digest, &second.weights_digest);
    let same_weights = matches!(digests, (Some(a), Some(b)) if a == b);
    // Other seeds may well come to the same: a game that is won whole, or lost.
    let other_seed = matches!((first.seed, second.seed), (Some(a), Some(b)) if a != b);
    let same_curve = !other_seed && !first.evaluations.is_empty() && first.evaluations == second.evaluations;
    if !(same_seed || same_weights || same_curve) {
        return Ok(());
    }
    let (first, second, seed) = (first.name.clone(), second.name.clone(), second.seed);
    Err(ReportError::Twice { first, second, seed })
}

/// Between versions anything may have changed, of one method as of several.
fn refuse_other_versions(runs: &[Record]) -> Result<(), ReportError> {
    let mut known = runs.iter().filter_map(|run| Some((run, &run.build.as_ref()?.version)));
    let Some((first, version)) = known.next() else { return Ok(()) };
    match known.find(|(_, other)| *other != version) {
        None => Ok(()),
        Some((second, other)) => Err(ReportError::Versions {
            first: first.name.clone(),
            second: second.name.clone(),
            versions: (version.clone(), other.clone()),
        }),
    }
}

fn refuse_other_kind(
    first: &Record,
    second: &Record,
    method: &str,
    task_set: &str,
) -> Result<(), ReportError> {
    if first.kind == second.kind {
        return Ok(());
    }
    let keys: BTreeSet<&String> = first.kind.keys().chain(second.kind.keys()).collect();
    let by: Vec<String> =
        keys.into_iter().filter(|key| first.kind.get(*key) != second.kind.get(*key)).cloned().collect();
    let word =
        |run: &Record, key: &String| run.kind.get(key).cloned().unwrap_or_else(|| "unknown".to_owned());
    Err(Box::new(OtherKind {
        differences: by
            .iter()
            .map(|key| format!("{key} ({}, {})", word(first, key), word(second, key)))
            .collect(),
        by,
        first: first.name.clone(),
        second: second.name.clone(),
        method: method.to_owned(),
        task_set: task_set.to_owned(),
    })
    .into())
}

/// Refuses finished runs of a method that were to take another number of environment steps: no result follows from that
/// while they run, but their ends are not of one kind.
///
/// # Errors
/// When there are such.
pub fn refuse_other_lengths(groups: &[Group]) -> Result<(), ReportError> {
    let length = |run: &Record| run.settings.get(LENGTH).cloned();
    for (group, method) in groups.iter().flat_map(|group| group.methods.iter().map(move |it| (group, it))) {
        let first = &method.runs[0];
        let Some(other) = method.runs.iter().find(|run| length(run) != length(first)) else { continue };
        let [a, b] = [first, other].map(|run| length(run).unwrap_or_else(|| "unknown".to_owned()));
        return Err(Box::new(OtherKind {
            first: first.name.clone(),
            second: other.name.clone(),
            method: method.label.clone(),
            task_set: group.task_set.clone(),
            differences: vec![format!("{LENGTH} ({a}, {b})")],
            by: vec![LENGTH.to_owned()],
        })
        .into());
    }
    Ok(())
}

fn refuse_other_intervals(methods: &[Method]) -> Result<(), ReportError> {
    let interval = |method: &Method| method.runs[0].kind.get(INTERVAL).cloned().unwrap_or_default();
    let Some((first, rest)) = methods.split_first() else { return Ok(()) };
    match rest.iter().find(|method| interval(method) != interval(first)) {
        None => Ok(()),
        Some(other) => Err(ReportError::Intervals {
            interval: (interval(first), interval(other)),
            first: first.runs[0].name.clone(),
            second: other.runs[0].name.clone(),
        }),
    }
}

fn names(run: &Record, split: Split) -> Vec<String> {
    run.tasks(split).into_iter().map(str::to_owned).collect()
}

/// What the record says; of an older one the set whose training tasks it plays, or else its folder.
fn task_set(run: &Record, training: &[String]) -> String {
    if let Some(task_set) = run.task_set() {
        return task_set.to_owned();
    }
    let found = TaskSet::ALL.into_iter().find(|set| is_whole(&set.to_string(), training));
    found.map_or_else(|| run.folder.clone(), |set| set.to_string())
}

/// Whether these are all training tasks of the set.
fn is_whole(task_set: &str, training: &[String]) -> bool {
    let Ok(task_set) = task_set.parse::<TaskSet>() else { return false };
    let all: BTreeSet<String> = task_set.tasks(Split::Training).iter().map(ToString::to_string).collect();
    all == training.iter().cloned().collect()
}

/// Tasks as the set lists them; then others by their names.
fn in_order(task_set: &str, split: Split, mut tasks: Vec<String>) -> Vec<String> {
    let listed: Vec<String> = task_set
        .parse::<TaskSet>()
        .map(|set| set.tasks(split).iter().map(ToString::to_string).collect())
        .unwrap_or_default();
    let place = |task: &String| listed.iter().position(|it| it == task).unwrap_or(usize::MAX);
    tasks.sort_by_key(|task| (place(task), task.clone()));
    tasks
}
