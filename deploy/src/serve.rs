//! `rit serve`: a folder of runs or a sweep in a browser of this machine. Each request looks for what has changed, so a
//! sweep that still runs fills up as one looks; runs whose files have not changed are not read again.

mod address;

use crate::{
    cli::ServeOptions, experiments::plain_settings, failure::Failure, output, player::Trained, render,
    shutdown,
};
use address::RUNS;
use axum::{
    Router,
    extract::{Path as UrlPath, Query, State},
    http::{StatusCode, header},
    response::{Html, IntoResponse, Response},
    routing::get,
};
use rit_config::WebListen;
use rit_env::{Split, TaskSet};
use rit_learner::{
    checkpoint::Which,
    evaluation::Evaluator,
    trainer::evaluation_seed,
    web::{Door, Gate, Home, guarded},
};
use rit_record::{Record, RecordError};
use rit_report::{
    CSS, Figure, Group, Input, Measure, Options, ReportError, Section, Styles, SweepState, Table, chart,
    figures::{self, Drawn},
    groups, page, read_by,
};
use rustix::rand::{GetRandomFlags, getrandom};
use serde::Deserialize;
use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    fs,
    path::{Path, PathBuf},
    process::ExitCode,
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, SystemTime},
};
use tokio::sync::oneshot;

/// How long open connections are waited for once it is to end; browsers hold idle ones.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(1);
/// Bytes of the token, and of the cookie's name.
const TOKEN_BYTES: usize = 16;
const NAME_BYTES: usize = 4;

/// What is shown.
struct Shown {
    folder: PathBuf,
    by: Vec<String>,
    /// Runs that were read, with their files as they were then.
    known: Mutex<HashMap<PathBuf, (Stamp, Record)>>,
}

/// Length and time of each file that a record is made from; nothing for one that is not there.
type Stamp = Vec<Option<(u64, SystemTime)>>;

/// `rit serve`.
///
/// # Errors
/// When the folder holds no run, or the address cannot be had.
pub async fn run(options: ServeOptions) -> Result<ExitCode, Failure> {
    let WebListen::On(address) = options.listen else {
        return Err(Failure::input_message("--listen off: write an address, such as 127.0.0.1:8080"));
    };
    let shown = Shown { folder: options.folder, by: options.by, known: Mutex::default() };
    shown.read()?;
    let mut bytes = [0; TOKEN_BYTES + NAME_BYTES];
    getrandom(&mut bytes, GetRandomFlags::empty()).map_err(Failure::runtime)?;
    let (token, name) = bytes.split_at(TOKEN_BYTES);
    let token: String = token.iter().map(|byte| format!("{byte:02x}")).collect();
    let door = Door::bind(address)
        .await
        .map_err(|error| Failure::input_message(format!("--listen {address}: {error}")))?;
    // Caught before it says where it listens.
    let requested = shutdown::requested(false);
    output::print(&format!("web page: http://{}/?token={token}\n", door.address()))?;
    let routes = Router::new()
        .route(RUNS, get(all))
        .route("/runs/{run}", get(one))
        .route("/runs/{run}/{task}/{number}", get(episode))
        .route("/runs/{run}/{task}/{number}/episode.gif", get(film))
        .route("/page.css", get(|| async { ([(header::CONTENT_TYPE, "text/css; charset=utf-8")], CSS) }))
        .with_state(Arc::new(shown));
    let (end, ended) = oneshot::channel();
    let closing = async move {
        requested.await;
        drop::<oneshot::Sender<()>>(end);
        tokio::time::sleep(CLOSE_TIMEOUT).await;
    };
    let routes = guarded(Gate::new(&token, name, Home::Path(RUNS)), routes);
    tokio::select! {
        () = door.serve(routes, async { drop(ended.await) }) => {}
        () = closing => {}
    }
    Ok(ExitCode::SUCCESS)
}

impl Shown {
    fn read(&self) -> Result<Input, ReportError> {
        read_by(std::slice::from_ref(&self.folder), |path| self.record(path))
    }

    /// The run of a path, without the lines of training, which no page shows.
    fn record(&self, path: &Path) -> Result<Record, RecordError> {
        let known = || self.known.lock().unwrap_or_else(PoisonError::into_inner);
        // Taken before it is read: what is written meanwhile makes another.
        let stamp = stamp(path);
        if let Some((_, record)) = known().get(path).filter(|(then, _)| *then == stamp) {
            return Ok(record.clone());
        }
        let record = Record { training: Vec::new(), ..Record::read(path)? };
        known().insert(path.to_owned(), (stamp, record.clone()));
        Ok(record)
    }

    /// The run of this name: one of those that are found, so an address leads nowhere else.
    fn run(&self, name: &str) -> Result<Record, Wrong> {
        self.read()?.runs.into_iter().find(|run| self.name(run) == name).ok_or(Wrong::NotFound)
    }

    /// The run of this name if it has such a task, and the number after this one: the last number has none, and no episode.
    fn episode(&self, name: &str, task: &str, number: u64) -> Result<(Record, u64), Wrong> {
        let run = self.run(name)?;
        let next = number.checked_add(1).filter(|_| tasks(&run).contains(task));
        next.map(|next| (run, next)).ok_or(Wrong::NotFound)
    }

    fn name(&self, run: &Record) -> String {
        let inside = self
            .folder
            .canonicalize()
            .ok()
            .and_then(|root| Some(run.path.strip_prefix(root).ok()?.to_owned()));
        match inside {
            Some(inside) if !inside.as_os_str().is_empty() => inside.display().to_string(),
            _ => run.folder.clone(),
        }
    }
}

/// Of a run directory, or of a committed record and the folder that has what else is kept of it.
fn stamp(path: &Path) -> Stamp {
    let files = if path.is_dir() {
        ["metrics.jsonl", "config.toml", "summary.json", "shapley"].map(|name| path.join(name)).to_vec()
    } else {
        let folder = path.parent().unwrap_or(path);
        vec![path.to_owned(), path.with_extension("json"), folder.to_owned()]
    };
    let of = |path: PathBuf| {
        let metadata = fs::metadata(path).ok()?;
        Some((metadata.len(), metadata.modified().ok()?))
    };
    files.into_iter().map(of).collect()
}

/// Why there is no answer.
enum Wrong {
    NotFound,
    Said(String),
}

impl<E: std::fmt::Display> From<E> for Wrong {
    fn from(error: E) -> Self {
        Self::Said(error.to_string())
    }
}

impl IntoResponse for Wrong {
    fn into_response(self) -> Response {
        let (status, words) = match self {
            Self::NotFound => (StatusCode::NOT_FOUND, "there is nothing here".to_owned()),
            Self::Said(words) => (StatusCode::INTERNAL_SERVER_ERROR, words),
        };
        let mut section = Section::new("wrong", "It cannot be shown");
        section.text.push(words);
        section.links.push((RUNS.to_owned(), "all runs".to_owned()));
        (status, Html(page("Runs", &[section], Some("/page.css")))).into_response()
    }
}

/// Rolling and drawing take a while: not on the threads that answer.
async fn apart<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, Wrong> + Send + 'static,
) -> Result<T, Wrong> {
    tokio::task::spawn_blocking(work).await.map_err(|error| Wrong::Said(error.to_string()))?
}

fn html(title: &str, sections: &[Section]) -> Html<String> {
    Html(page(title, sections, Some("/page.css")))
}

#[derive(Deserialize)]
struct Measured {
    /// What curves show: `return` or `win_rate`; what the paper shows where it is not said.
    measure: Option<String>,
}

async fn all(
    State(shown): State<Arc<Shown>>,
    Query(measured): Query<Measured>,
) -> Result<Html<String>, Wrong> {
    apart(move || {
        let input = shown.read()?;
        let mut runs = Section::new("runs", "Runs");
        runs.text.extend(input.sweeps.iter().map(SweepState::words));
        let links = input.runs.iter().map(|run| address::run(&shown.name(run))).collect();
        runs.tables.push(Table { links, ..table(&shown, &input.runs) });
        let curves = curves(&shown, input, measured.measure.as_deref())?;
        Ok(html(&format!("Runs in {}", shown.folder.display()), &[curves, runs]))
    })
    .await
}

/// Curves of all runs that were ever evaluated, or why they cannot lie over each other.
fn curves(shown: &Shown, input: Input, measure: Option<&str>) -> Result<Section, Wrong> {
    let mut section = Section::new("curves", "Learning curves");
    let measure = match measure {
        Some("return") => Some(Measure::Return),
        Some("win_rate") => Some(Measure::WinRate),
        _ => None,
    };
    let by = input.keys_by(&shown.by);
    let of_run = |run: &Record| {
        run.evaluations.iter().flat_map(|it| it.tasks.values()).any(|it| it.win_rate.is_some())
    };
    let has_wins = input.runs.iter().any(of_run);
    // What cannot be compared on one task set keeps no other's curves away.
    let mut sets: BTreeMap<(String, Option<String>), Vec<Record>> = BTreeMap::new();
    for run in input.runs.into_iter().filter(|run| !run.evaluations.is_empty()) {
        let task_set = run.task_set().unwrap_or(&run.folder).to_owned();
        let interval = run.kind.get("evaluation.every_env_steps").cloned();
        sets.entry((task_set, interval)).or_default().push(run);
    }
    for runs in sets.into_values() {
        let options = Options { measure, by: by.clone(), plain: plain_settings, ..Options::default() };
        set_curves(&mut section, &runs, options)?;
    }
    if has_wins {
        section.links.push((format!("{RUNS}?measure=return"), "returns".to_owned()));
        section.links.push((format!("{RUNS}?measure=win_rate"), "win rates".to_owned()));
    }
    Ok(section)
}

/// Curves of the runs of one task set that were evaluated as often.
fn set_curves(section: &mut Section, runs: &[Record], options: Options) -> Result<(), Wrong> {
    match apart_by_settings(runs, options) {
        Err(error) => section.text.push(error.to_string()),
        Ok((groups, keys)) => {
            if !keys.is_empty() {
                section
                    .text
                    .push(format!("Runs of a method that differ in {} are drawn apart.", keys.join(", ")));
            }
            let styles = Styles::of(&groups);
            for group in &groups {
                let methods: Vec<_> = group.methods.iter().collect();
                let chart = figures::chart(group, &methods, Split::Training, Drawn::MeanAndInterval, &styles);
                section.figures.push(Figure {
                    id: group.id.clone(),
                    title: group.title.clone(),
                    caption: format!(
                        "Mean over seeds and tasks, finished or not; bands: 95 % intervals, where there are 5 seeds or more; \
                         thin lines: single runs.{}",
                        Measure::ends("Bands", [group.measure])
                    ),
                    svg: chart::curves(&[chart])?,
                });
            }
        }
    }
    Ok(())
}

/// Runs that may be averaged, put together; those of one method that differ in settings are methods of their own, and the
/// keys are returned. Where too many settings differ for a label, it stays an error.
fn apart_by_settings(
    runs: &[Record],
    mut options: Options,
) -> Result<(Vec<Group>, Vec<String>), ReportError> {
    /// In what is shown of a label.
    const KEYS_MAX: usize = 4;
    let mut keys: Vec<String> = Vec::new();
    loop {
        let error = match groups(runs.to_vec(), &options) {
            Ok(groups) => return Ok((groups, keys)),
            Err(error) => error,
        };
        let ReportError::Kinds(kinds) = &error else { return Err(error) };
        // Records without settings are told apart by their folders.
        let folder = kinds.by.iter().find(|key| *key == "folder");
        let differing = folder.map_or_else(|| kinds.by.clone(), |folder| vec![folder.clone()]);
        let new: Vec<String> = differing.into_iter().filter(|key| !options.by.contains(key)).collect();
        if new.is_empty() || keys.len() + new.len() > KEYS_MAX {
            return Err(error);
        }
        keys.extend(new.iter().cloned());
        options.by.extend(new);
    }
}

fn table(shown: &Shown, runs: &[Record]) -> Table {
    let row = |run: &Record| {
        let or_dash = |text: Option<String>| text.unwrap_or_else(|| "–".to_owned());
        let state = run.ended.map_or_else(|| "runs, or was killed".to_owned(), |ended| ended.to_string());
        let last = run.evaluations.iter().rfind(|it| it.split == Split::Training);
        let last = last.and_then(|evaluation| {
            let results: Vec<_> = evaluation.tasks.values().map(rit_learner::messages::task_result).collect();
            crate::report::in_words(&results)
        });
        vec![
            shown.name(run),
            or_dash(run.method().map(str::to_owned)),
            or_dash(run.task_set().map(str::to_owned)),
            or_dash(run.seed.map(|seed| seed.to_string())),
            state,
            crate::report::grouped(run.progress.env_steps),
            or_dash(last),
        ]
    };
    let head =
        ["run", "method", "task set", "seed", "state", "env. steps", "last evaluation, mean over tasks"];
    Table {
        id: "all-runs".to_owned(),
        title: String::new(),
        head: head.map(str::to_owned).to_vec(),
        rows: runs.iter().map(row).collect(),
        note: String::new(),
        ..Table::default()
    }
}

async fn one(State(shown): State<Arc<Shown>>, UrlPath(name): UrlPath<String>) -> Result<Html<String>, Wrong> {
    apart(move || {
        let run = shown.run(&name)?;
        let mut facts = Section::new("run", "The run");
        facts.tables.push(table(&shown, std::slice::from_ref(&run)));
        facts.links.push((RUNS.to_owned(), "all runs".to_owned()));
        let mut sections = vec![facts];
        sections.push(by_task(run.clone())?);
        let mut episodes = Section::new("episodes", "Greedy episodes with its checkpoint");
        if run.path.join("checkpoints").is_dir() {
            for task in tasks(&run) {
                episodes.links.push((address::episode(&name, &task, 0), task));
            }
        } else {
            episodes.text.push("It has left no checkpoint here to replay episodes from.".to_owned());
        }
        sections.push(episodes);
        Ok(html(&name, &sections))
    })
    .await
}

/// A run's curve on each of its tasks, trained on or not.
fn by_task(run: Record) -> Result<Section, Wrong> {
    let mut section = Section::new("tasks", "Task by task");
    if run.evaluations.is_empty() {
        section.text.push("It was not evaluated yet.".to_owned());
        return Ok(section);
    }
    let groups = groups(vec![run], &Options::default())?;
    let styles = Styles::of(&groups);
    for group in &groups {
        let of_task = |(split, task): (Split, &String)| {
            let alone = Group {
                training: if split == Split::Training { vec![task.clone()] } else { Vec::new() },
                testing: if split == Split::Testing { vec![task.clone()] } else { Vec::new() },
                title: format!("{task}{}", if split == Split::Testing { " (unseen)" } else { "" }),
                ..group.clone()
            };
            let methods: Vec<_> = alone.methods.iter().collect();
            figures::chart(&alone, &methods, split, Drawn::MeanAndInterval, &styles)
        };
        let tasks = group.training.iter().map(|task| (Split::Training, task));
        let tasks = tasks.chain(group.testing.iter().map(|task| (Split::Testing, task)));
        let methods: Vec<_> = group.methods.iter().collect();
        let mean = |split: Split, title: &str| {
            let all = Group { title: title.to_owned(), ..group.clone() };
            (group.tasks(split).len() > 1)
                .then(|| figures::chart(&all, &methods, split, Drawn::MeanAndInterval, &styles))
        };
        let means =
            mean(Split::Training, "training tasks").into_iter().chain(mean(Split::Testing, "unseen tasks"));
        let charts: Vec<_> = means
            .chain(tasks.map(of_task))
            .filter(|chart| chart.lines.iter().any(|it| it.points.len() > 1))
            .collect();
        if charts.is_empty() {
            section.text.push("It was evaluated once so far.".to_owned());
            continue;
        }
        section.figures.push(Figure {
            id: group.id.clone(),
            title: group.title.clone(),
            caption: "Scheduled greedy evaluations.".to_owned(),
            svg: chart::curves(&charts)?,
        });
    }
    Ok(section)
}

/// Names of the tasks that a run was evaluated on.
fn tasks(run: &Record) -> BTreeSet<String> {
    [Split::Training, Split::Testing]
        .into_iter()
        .flat_map(|split| run.tasks(split))
        .map(str::to_owned)
        .collect()
}

async fn episode(
    State(shown): State<Arc<Shown>>,
    UrlPath((run, task, number)): UrlPath<(String, String, u64)>,
) -> Result<Html<String>, Wrong> {
    apart(move || {
        let (record, next) = shown.episode(&run, &task, number)?;
        let mut section = Section::new("episode", &format!("{task}, episode {number}"));
        if has_scenes(&record, &task) {
            section.image = Some((address::film(&run, &task, number), format!("episode {number} of {task}")));
        } else {
            section.tables.push(steps(&record, &task, number)?);
        }
        if let Some(before) = number.checked_sub(1) {
            section.links.push((address::episode(&run, &task, before), "episode before".to_owned()));
        }
        section.links.push((address::episode(&run, &task, next), "next episode".to_owned()));
        section.links.push((address::run(&run), "the run".to_owned()));
        section.links.push((RUNS.to_owned(), "all runs".to_owned()));
        Ok(html(&run, &[section]))
    })
    .await
}

/// Whether a task's states can be drawn.
fn has_scenes(run: &Record, task: &str) -> bool {
    let task_set = run.task_set().and_then(|task_set| task_set.parse::<TaskSet>().ok());
    task_set.and_then(|set| set.task(task).ok()).is_some_and(|task| task.spec().has_scenes)
}

/// What was done at each step of an episode in which nothing has a place.
fn steps(run: &Record, task: &str, number: u64) -> Result<Table, Wrong> {
    let trained = Trained::load(&run.path, Which::default())?;
    let task = trained.config.environment.task_set.task(task)?;
    let (evaluator, seed) = (Evaluator::new(&trained.config), evaluation_seed(&trained.config));
    let rolled = evaluator.watch(trained.policy().as_mut(), task, number..number + 1, seed, |_, _| {})?;
    let episode = rolled.first().ok_or(Wrong::NotFound)?;
    let row = |(step, (joint, reward)): (usize, (&[u8], &f32))| {
        let mut actions = vec![String::new(); joint.len()];
        for (&agent, action) in episode.decision_order.iter().zip(joint) {
            actions[usize::from(agent)] = action.to_string();
        }
        [(step + 1).to_string()].into_iter().chain(actions).chain([format!("{reward:.2}")]).collect()
    };
    let joints = episode.actions.chunks_exact(episode.n_agents).zip(&episode.rewards).enumerate();
    let agents = (1..=episode.n_agents).map(|agent| format!("agent {agent}"));
    Ok(Table {
        id: "steps".to_owned(),
        title: format!("Actions and rewards{}", if episode.won { ": won" } else { "" }),
        head: ["step".to_owned()].into_iter().chain(agents).chain(["reward".to_owned()]).collect(),
        rows: joints.map(row).collect(),
        note: String::new(),
        ..Table::default()
    })
}

async fn film(
    State(shown): State<Arc<Shown>>,
    UrlPath((run, task, number)): UrlPath<(String, String, u64)>,
) -> Result<Response, Wrong> {
    let gif = apart(move || {
        let (record, _) = shown.episode(&run, &task, number)?;
        Ok(render::replay(&record.path, &task, number)?)
    });
    Ok(([(header::CONTENT_TYPE, "image/gif")], gif.await?).into_response())
}
