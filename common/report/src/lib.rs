//! The experimental section of a paper, from records of runs: figures, tables, one page, marl-eval's JSON and a flat CSV.
//!
//! [`read`] finds the runs of folders, sweeps and committed records; [`groups`] puts together what may be averaged, and
//! refuses the rest in words; [`report`] makes the files. Statistics come from `rit-statistics`, and nothing here knows a
//! clock: the same records give the same files.

mod aggregate;
pub mod chart;
mod comparison;
mod data;
mod error;
pub mod figures;
mod measure;
mod page;
mod paper;
mod results;
mod setup;
mod shapley;
mod table;

pub use comparison::{Group, Method, Options, Settings, groups};
pub use error::ReportError;
pub use measure::{Measure, signed};
pub use page::{CSS, GENERATOR, Section, page};
pub use shapley::figure as shapley_figure;
pub use table::Table;

use rit_env::Split;
use rit_record::{Cell, CellState, Record, RecordError, Sweep};
use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

/// A figure.
#[derive(Clone, Debug)]
pub struct Figure {
    /// Its file's name, without ending.
    pub id: String,
    /// Above it.
    pub title: String,
    /// Below it: what is shown, and how it was computed.
    pub caption: String,
    /// The picture.
    pub svg: String,
}

/// In which colour each method is drawn, the same in every figure of a report.
#[derive(Clone, Debug, Default)]
pub struct Styles(BTreeMap<String, usize>);

impl Styles {
    /// A method of the paper has a colour of its own; others share what is left.
    pub fn of(groups: &[Group]) -> Self {
        let mut styles = BTreeMap::new();
        let known = rit_algo::Method::ALL.map(|method| method.facts().name);
        let labels = || groups.iter().flat_map(|group| group.methods.iter().map(|method| &method.label));
        let others: std::collections::BTreeSet<&String> =
            labels().filter(|label| !known.contains(&label.as_str())).collect();
        for (at, name) in known.into_iter().enumerate() {
            styles.insert(name.to_owned(), at);
        }
        for (at, label) in others.into_iter().enumerate() {
            styles.insert(label.clone(), known.len() + at);
        }
        Self(styles)
    }

    /// Of a method.
    pub fn key(&self, label: &str) -> chart::Key {
        chart::Key { label: label.to_owned(), style: self.0.get(label).copied().unwrap_or(0) }
    }
}

/// What was found under some paths.
#[derive(Debug, Default)]
pub struct Input {
    /// Every run, finished or not.
    pub runs: Vec<Record>,
    /// How each sweep stands.
    pub sweeps: Vec<SweepState>,
}

impl Input {
    /// The keys whose values are methods of their own: those asked for, and those that sweeps compare. Task sets are told
    /// apart anyway.
    pub fn keys_by(&self, asked: &[String]) -> Vec<String> {
        let is_known = |key: &&String| {
            !key.starts_with("environment.t") && self.runs.iter().any(|run| run.settings.contains_key(*key))
        };
        let axes = self.sweeps.iter().flat_map(|sweep| &sweep.axes).filter(is_known);
        let mut keys: Vec<String> = Vec::new();
        for key in asked.iter().chain(axes) {
            if !keys.contains(key) {
                keys.push(key.clone());
            }
        }
        keys
    }
}

/// How a sweep stands.
#[derive(Debug)]
pub struct SweepState {
    /// Its folder, as it was given.
    pub name: String,
    /// Keys that its cells differ in.
    pub axes: Vec<String>,
    /// Cells that are done.
    pub finished: usize,
    /// Names of the others, and how each stands.
    pub missing: Vec<(String, String)>,
}

impl SweepState {
    /// How far it has come, for people.
    pub fn words(&self) -> String {
        let all = self.finished + self.missing.len();
        if self.missing.is_empty() {
            return format!("Sweep {}: all {all} runs are finished.", self.name);
        }
        let names = self.missing.iter().map(|(name, state)| format!("{name} ({state})"));
        format!(
            "Sweep {}: {} of {all} runs are missing: {}.",
            self.name,
            self.missing.len(),
            shortened(names.collect())
        )
    }
}

/// Finds and reads the runs.
///
/// # Errors
/// When a path holds none, or one cannot be read.
pub fn read(paths: &[PathBuf]) -> Result<Input, ReportError> {
    read_by(paths, Record::read)
}

/// The same, each run read by this function.
///
/// # Errors
/// As [`read`].
pub fn read_by(
    paths: &[PathBuf],
    record: impl Fn(&Path) -> Result<Record, RecordError>,
) -> Result<Input, ReportError> {
    let mut input = Input::default();
    for (at, path) in paths.iter().enumerate() {
        if let Some(first) = paths[..at].iter().find(|first| *first == path) {
            let [first, second] = [first, path].map(|path| path.display().to_string());
            return Err(ReportError::Twice { first, second, seed: None });
        }
    }
    for path in paths.iter().filter(|path| path.is_dir()) {
        input.sweeps.extend(Sweep::read(path)?.map(|sweep| state(path, &sweep)));
    }
    for path in rit_record::discover(paths)? {
        input.runs.push(record(&path)?);
    }
    Ok(input)
}

fn state(dir: &Path, sweep: &Sweep) -> SweepState {
    let words = |cell: &Cell| match Sweep::state(dir, cell) {
        CellState::Waiting => Some(match Sweep::failure(dir, cell) {
            Some(why) => format!("failed: {why}"),
            None => "has not begun".to_owned(),
        }),
        CellState::Begun => Some("runs, or was killed".to_owned()),
        CellState::Ended(ended) if ended.is_whole() => None,
        CellState::Ended(ended) => Some(ended.to_string()),
    };
    let missing: Vec<_> =
        sweep.cells.iter().filter_map(|cell| Some((cell.name.clone(), words(cell)?))).collect();
    SweepState {
        name: dir.display().to_string(),
        axes: sweep.axes.clone(),
        finished: sweep.cells.len() - missing.len(),
        missing,
    }
}

/// The files of a report, by their paths in its folder.
#[derive(Debug)]
pub struct Report {
    /// Path and content.
    pub files: Vec<(PathBuf, Vec<u8>)>,
    /// What a person is told, line by line.
    pub said: Vec<String>,
}

/// Finished runs, put together; and the others.
///
/// # Errors
/// When none has finished, or they cannot be compared.
pub fn finished(input: &Input, options: &Options) -> Result<(Vec<Group>, Vec<Record>), ReportError> {
    let (whole, rest): (Vec<Record>, Vec<Record>) = input.runs.iter().cloned().partition(Record::is_whole);
    if whole.is_empty() {
        return Err(ReportError::NoneFinished(counted(input.runs.len(), "run")));
    }
    let groups = groups(whole, options)?;
    comparison::refuse_other_lengths(&groups)?;
    let known: Vec<String> =
        groups.iter().flat_map(|group| group.methods.iter().map(|method| method.label.clone())).collect();
    for name in options.pairs.iter().flat_map(|(x, y)| [x, y]) {
        if !known.contains(name) {
            let (name, known) = (name.clone(), known.clone());
            return Err(ReportError::Pair { name, known });
        }
    }
    Ok((groups, rest))
}

/// Makes the report of groups of finished runs; `more` are sections that are made elsewhere, such as what takes a run's
/// weights.
///
/// # Errors
/// When a figure cannot be drawn.
pub fn report(
    input: &Input,
    groups: &[Group],
    unfinished: &[Record],
    options: &Options,
    more: Vec<Section>,
) -> Result<Report, ReportError> {
    let styles = Styles::of(groups);
    let mut standing = standing(input, groups, unfinished);
    let said = standing.text.clone();
    let about = |group: &Group| Some(format!("{}: {}", group.title, paper::about(&group.task_set)?));
    standing.text.extend(groups.iter().filter_map(about));
    standing.tables.push(setup::methods(groups));
    let mut sections = vec![standing];
    let mut curves = Section::new("curves", "Learning curves");
    curves.figures = figures::learning_curves(groups, &styles)?;
    sections.push(curves);
    let mut zero_shot = Section::new("results", "Results");
    zero_shot.tables = results::of_the_paper(groups, options);
    zero_shot.tables.extend(groups.iter().map(results::by_task));
    sections.push(zero_shot);
    sections.push(over_tasks(groups, options, &styles)?);
    let mut unseen = Section::new("generalisation", "Generalisation");
    unseen.figures.extend(figures::zero_shot_curves(groups, &styles)?);
    unseen.figures.extend(figures::team_sizes(groups, &styles)?);
    unseen.tables.extend(results::gaps(groups));
    sections.push(unseen);
    let mut variation = Section::new("variation", "Variation between runs");
    variation.tables.extend(results::variation(groups));
    sections.push(variation);
    sections.push(shapley::section(groups)?);
    sections.extend(more);
    let mut setup = Section::new("setup", "Everything that is not the algorithm");
    setup.tables = vec![setup::protocol(groups)];
    setup.tables.extend(setup::runs(groups));
    setup.tables.extend(setup::settings(groups));
    sections.push(setup);
    sections.retain(|section| !section.is_empty());
    files(groups, &sections, said)
}

fn files(groups: &[Group], sections: &[Section], said: Vec<String>) -> Result<Report, ReportError> {
    let json = serde_json::to_vec(&data::marl_eval(groups));
    let json = json.map_err(|error| ReportError::Write(format!("marl-eval.json: {error}")))?;
    let mut files = vec![
        (PathBuf::from("index.html"), page("Comparison of runs", sections, None).into_bytes()),
        (PathBuf::from("marl-eval.json"), json),
        (PathBuf::from("runs.csv"), data::flat(groups)?),
    ];
    for section in sections {
        for figure in &section.figures {
            files.push((format!("figures/{}.svg", figure.id).into(), figure.svg.clone().into_bytes()));
        }
        for table in &section.tables {
            files.push((format!("tables/{}.md", table.id).into(), table.markdown().into_bytes()));
        }
    }
    Ok(Report { files, said })
}

/// How far the runs have come, and what of the report is to be taken with care.
fn standing(input: &Input, groups: &[Group], unfinished: &[Record]) -> Section {
    let mut section = Section::new("standing", "What was run");
    let runs = || groups.iter().flat_map(|group| group.methods.iter().map(|method| method.runs.len()));
    let (finished, cells) = (runs().sum::<usize>(), runs().count());
    let labels = groups.iter().flat_map(|group| group.methods.iter().map(|method| &method.label));
    let methods = labels.collect::<std::collections::BTreeSet<_>>().len();
    let (fewest, most) = (runs().min().unwrap_or(0), runs().max().unwrap_or(0));
    let seeds = if fewest == most { counted(most, "seed") } else { format!("{fewest} to {most} seeds") };
    section.text.push(format!(
        "{}: {} on {}, {seeds} each.",
        counted(finished, "finished run"),
        counted(methods, "method"),
        counted(groups.len(), "task set")
    ));
    section.text.extend(input.sweeps.iter().map(SweepState::words));
    // Those of sweeps have been named.
    let of_a_sweep =
        |run: &Record| input.sweeps.iter().any(|sweep| Path::new(&run.name).starts_with(&sweep.name));
    let others: Vec<String> =
        unfinished.iter().filter(|run| !of_a_sweep(run)).map(|run| run.name.clone()).collect();
    if !others.is_empty() {
        section.text.push(format!("Not finished, and left out: {}.", shortened(others)));
    }
    let few = groups.iter().flat_map(|group| &group.methods).filter(|method| !method.is_reliable()).count();
    if few > 0 {
        section.text.push(format!(
            "{few} of {} (a method on a task set) {} fewer than 5 seeds: the intervals are not reliable. Figures draw the \
             runs instead, and tables mark them with †.",
            counted(cells, "cell"),
            if few == 1 { "has" } else { "have" }
        ));
    }
    section.text.extend(groups.iter().filter_map(uneven));
    let torn: usize = input.runs.iter().map(|run| run.broken_lines).sum();
    if torn > 0 {
        section.text.push(format!("{torn} lines of the runs' metrics cannot be read and are left out."));
    }
    section
}

/// Methods of a group that were not treated alike.
fn uneven(group: &Group) -> Option<String> {
    let seeds = |method: &Method| method.runs.len();
    // A record may not say it.
    let steps = |method: &Method| method.runs[0].settings.get("training.t_max").cloned();
    let all_steps: std::collections::BTreeSet<String> = group.methods.iter().filter_map(steps).collect();
    let first = group.methods.first()?;
    let mut words = Vec::new();
    if group.methods.iter().any(|method| seeds(method) != seeds(first)) {
        words.push(format!(
            "methods have different numbers of seeds; marl-eval.json, which wants as many of each, has the first {}",
            group.seeds_min()
        ));
    }
    if all_steps.len() > 1 {
        words.push("methods were trained for different numbers of environment steps".to_owned());
    }
    (!words.is_empty()).then(|| format!("{}: {}.", group.title, words.join("; ")))
}

/// "1 run", "2 runs".
fn counted(count: usize, what: &str) -> String {
    format!("{count} {what}{}", if count == 1 { "" } else { "s" })
}

fn shortened(names: Vec<String>) -> String {
    const SHOWN: usize = 12;
    let more = names.len().saturating_sub(SHOWN);
    let words = names.into_iter().take(SHOWN).collect::<Vec<_>>().join(", ");
    if more > 0 { format!("{words} and {more} more") } else { words }
}

fn over_tasks(groups: &[Group], options: &Options, styles: &Styles) -> Result<Section, ReportError> {
    let mut section = Section::new("aggregates", "Over tasks and seeds");
    for split in [Split::Training, Split::Testing] {
        let several = |group: &&Group| group.tasks(split).len() > 1;
        let scored: Vec<_> =
            groups.iter().filter(several).filter_map(|group| aggregate::scored(group, split)).collect();
        for scored in scored.iter().chain(&aggregate::joined(&scored)) {
            let (table, figure) = scored.aggregates(options, styles)?;
            section.tables.push(table);
            section.figures.push(figure);
            section.figures.push(scored.profile(options, styles)?);
            if let Some((table, figure)) = scored.improvement(options, styles)? {
                section.tables.push(table);
                section.figures.push(figure);
            }
            section.figures.extend(scored.sample_efficiency(options, styles)?);
        }
    }
    if !section.is_empty() {
        section.text.push(
            "A score is what one run comes to on one task, on a scale from 0 to 1. IQM, the interquartile mean: the mean of \
             the middle half of all scores. Median: of the tasks' means. Optimality gap: how far scores fall short of 1 on \
             average. Definitions are those of rliable (Agarwal et al., 2021) and marl-eval (Gorsane et al., 2022). A run \
             learns all tasks of a set at once, so its scores on them hang together; the bootstrap resamples runs within \
             each task as if they did not."
                .to_owned(),
        );
    }
    Ok(section)
}
