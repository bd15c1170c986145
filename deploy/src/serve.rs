//! `rit serve`: a folder of runs or a sweep in a browser of this machine. What can be seen is read anew for each request,
//! so a sweep that still runs fills up as one looks.

use crate::{cli::ServeOptions, failure::Failure, output, player::Trained, render, shutdown};
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
use rit_record::Record;
use rit_report::{
    CSS, Figure, Group, Input, Options, ReportError, Section, Styles, Table, chart, figures, groups, page,
    read,
};
use rustix::rand::{GetRandomFlags, getrandom};
use serde::Deserialize;
use std::{collections::BTreeSet, path::PathBuf, process::ExitCode, sync::Arc};

/// Where browsers that are let in are led.
const RUNS: &str = "/runs";
/// Bytes of the token, and of the cookie's name.
const TOKEN_BYTES: usize = 16;
const NAME_BYTES: usize = 4;

/// What is shown.
struct Shown {
    folder: PathBuf,
    by: Vec<String>,
}

/// `rit serve`.
///
/// # Errors
/// When the folder holds no run, or the address cannot be had.
pub async fn run(options: ServeOptions) -> Result<ExitCode, Failure> {
    let WebListen::On(address) = options.listen else {
        return Err(Failure::input_message("--listen off: write an address, such as 127.0.0.1:8080"));
    };
    let shown = Shown { folder: options.folder, by: options.by };
    shown.read()?;
    let mut bytes = [0; TOKEN_BYTES + NAME_BYTES];
    getrandom(&mut bytes, GetRandomFlags::empty()).map_err(Failure::runtime)?;
    let (token, name) = bytes.split_at(TOKEN_BYTES);
    let token: String = token.iter().map(|byte| format!("{byte:02x}")).collect();
    let door = Door::bind(address)
        .await
        .map_err(|error| Failure::input_message(format!("--listen {address}: {error}")))?;
    output::print(&format!("web page: http://{}/?token={token}\n", door.address()))?;
    let routes = Router::new()
        .route(RUNS, get(all))
        .route("/runs/{run}", get(one))
        .route("/runs/{run}/{task}/{number}", get(episode))
        .route("/runs/{run}/{task}/{number}/episode.gif", get(film))
        .route("/page.css", get(|| async { ([(header::CONTENT_TYPE, "text/css; charset=utf-8")], CSS) }))
        .with_state(Arc::new(shown));
    door.serve(guarded(Gate::new(&token, name, Home::Path(RUNS)), routes), shutdown::requested(false)).await;
    Ok(ExitCode::SUCCESS)
}

impl Shown {
    fn read(&self) -> Result<Input, ReportError> {
        read(std::slice::from_ref(&self.folder))
    }

    /// The run of this number, in the order in which they are found.
    fn run(&self, number: usize) -> Result<Record, Wrong> {
        self.read()?.runs.into_iter().nth(number).ok_or(Wrong::NotFound)
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
        for sweep in &input.sweeps {
            let all = sweep.finished + sweep.missing.len();
            runs.text.push(format!("{} of {all} runs of the sweep are finished.", sweep.finished));
        }
        runs.tables.push(table(&shown, &input.runs));
        let links = input.runs.iter().enumerate();
        runs.links = links.map(|(at, run)| (format!("{RUNS}/{at}"), shown.name(run))).collect();
        let curves = curves(&shown, input, measured.measure.as_deref())?;
        Ok(html(&format!("Runs in {}", shown.folder.display()), &[curves, runs]))
    })
    .await
}

/// Curves of all runs that were ever evaluated, or why they cannot lie over each other.
fn curves(shown: &Shown, input: Input, measure: Option<&str>) -> Result<Section, Wrong> {
    let mut section = Section::new("curves", "Learning curves");
    let measure = match measure {
        Some("return") => Some(rit_report::Measure::Return),
        Some("win_rate") => Some(rit_report::Measure::WinRate),
        _ => None,
    };
    let by = input.keys_by(&shown.by);
    let evaluated = input.runs.into_iter().filter(|run| !run.evaluations.is_empty()).collect();
    match groups(evaluated, &Options { measure, by, ..Options::default() }) {
        Err(error) => section.text.push(error.to_string()),
        Ok(groups) => {
            let styles = Styles::of(&groups);
            for group in &groups {
                let methods: Vec<_> = group.methods.iter().collect();
                let chart = figures::chart(group, &methods, Split::Training, &styles);
                section.figures.push(Figure {
                    id: group.id.clone(),
                    title: group.title.clone(),
                    caption: "Mean over seeds and tasks, finished or not; bands: 95 % intervals, where there are 5 seeds or \
                              more; thin lines: single runs."
                        .to_owned(),
                    svg: chart::curves(&[chart])?,
                });
            }
            if groups.iter().any(|group| {
                group.methods[0].runs[0]
                    .evaluations
                    .iter()
                    .any(|it| it.tasks.values().any(|result| result.win_rate.is_some()))
            }) {
                section.links.push((format!("{RUNS}?measure=return"), "returns".to_owned()));
                section.links.push((format!("{RUNS}?measure=win_rate"), "win rates".to_owned()));
            }
        }
    }
    Ok(section)
}

fn table(shown: &Shown, runs: &[Record]) -> Table {
    let row = |run: &Record| {
        let or_dash = |text: Option<String>| text.unwrap_or_else(|| "–".to_owned());
        let state = run.ended.map_or_else(|| "runs, or was killed".to_owned(), |ended| ended.to_string());
        let last = run.evaluations.iter().rfind(|it| it.split == Split::Training);
        let last = last.map(|evaluation| rit_record::in_words(evaluation.tasks.values()));
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
    let head = ["run", "method", "task set", "seed", "state", "env. steps", "last evaluation"];
    Table {
        id: "all-runs".to_owned(),
        title: String::new(),
        head: head.map(str::to_owned).to_vec(),
        rows: runs.iter().map(row).collect(),
        note: String::new(),
    }
}

async fn one(
    State(shown): State<Arc<Shown>>,
    UrlPath(number): UrlPath<usize>,
) -> Result<Html<String>, Wrong> {
    apart(move || {
        let run = shown.run(number)?;
        let name = shown.name(&run);
        let mut facts = Section::new("run", "The run");
        facts.tables.push(table(&shown, std::slice::from_ref(&run)));
        facts.links.push((RUNS.to_owned(), "all runs".to_owned()));
        let mut sections = vec![facts];
        sections.push(by_task(run.clone())?);
        let mut episodes = Section::new("episodes", "Greedy episodes with its checkpoint");
        if run.path.join("checkpoints").is_dir() {
            for task in tasks(&run) {
                episodes.links.push((format!("{RUNS}/{number}/{task}/0"), task));
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
                title: task.clone(),
                ..group.clone()
            };
            let methods: Vec<_> = alone.methods.iter().collect();
            figures::chart(&alone, &methods, split, &styles)
        };
        let tasks = group.training.iter().map(|task| (Split::Training, task));
        let tasks = tasks.chain(group.testing.iter().map(|task| (Split::Testing, task)));
        let charts: Vec<_> =
            tasks.map(of_task).filter(|chart| chart.lines.iter().any(|it| !it.points.is_empty())).collect();
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
    UrlPath((run, task, number)): UrlPath<(usize, String, u64)>,
) -> Result<Html<String>, Wrong> {
    apart(move || {
        let record = shown.run(run)?;
        if !tasks(&record).contains(&task) {
            return Err(Wrong::NotFound);
        }
        let mut section = Section::new("episode", &format!("{task}, episode {number}"));
        if has_scenes(&record, &task) {
            let address = format!("{RUNS}/{run}/{task}/{number}/episode.gif");
            section.image = Some((address, format!("episode {number} of {task}")));
        } else {
            section.tables.push(steps(&record, &task, number)?);
        }
        section.links.push((format!("{RUNS}/{run}/{task}/{}", number + 1), "next episode".to_owned()));
        section.links.push((format!("{RUNS}/{run}"), "the run".to_owned()));
        section.links.push((RUNS.to_owned(), "all runs".to_owned()));
        Ok(html(&shown.name(&record), &[section]))
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
    })
}

async fn film(
    State(shown): State<Arc<Shown>>,
    UrlPath((run, task, number)): UrlPath<(usize, String, u64)>,
) -> Result<Response, Wrong> {
    let gif = apart(move || {
        let record = shown.run(run)?;
        if !tasks(&record).contains(&task) {
            return Err(Wrong::NotFound);
        }
        Ok(render::replay(&record.path, &task, number)?)
    });
    Ok(([(header::CONTENT_TYPE, "image/gif")], gif.await?).into_response())
}
