//! What the page asks. Reading is GET, changing is POST; answers and errors are JSON.

use super::{Page, events};
use crate::{
    coordinator::Control,
    prometheus,
    run_handle::{AskError, Watched},
};
use axum::{
    Json, Router,
    extract::{Query, State, rejection::JsonRejection},
    http::{StatusCode, header},
    response::{IntoResponse, Response},
    routing::{get, post},
};
use rit_algo::Regime;
use rit_config::{open_regular, read_text};
use rit_env::{BodyKind, LinkKind, Scene, SceneLink, Split, Task};
use rit_episode::Action;
use rit_proto::{transport::AllTaken, v1};
use rit_record::Ended;
use serde::{Deserialize, Serialize};
use std::{
    fs::{self, OpenOptions},
    io::{self, Read as _, Seek as _, SeekFrom},
    path::Path,
};

/// Bytes of the end of a log that are shown.
const LOG_BYTES: u64 = 32 << 10;

pub fn router() -> Router<Page> {
    Router::new()
        .route("/api/run", get(run))
        .route("/api/events", get(events::events))
        .route("/api/log", get(log))
        .route("/metrics", get(prometheus))
        .route("/api/pause", post(pause))
        .route("/api/resume", post(resume))
        .route("/api/stop", post(stop))
        .route("/api/checkpoint", post(checkpoint))
        .route("/api/evaluate", post(evaluate))
        .route("/api/watch", post(watch))
}

/// Why there is no answer.
#[derive(Debug, thiserror::Error)]
pub enum ApiError {
    #[error(
        "the request does not carry the token: open the address with it that was printed (`rit ctl --run DIR web` \
         prints a run's)"
    )]
    Unauthorized,
    #[error("{0}")]
    Forbidden(&'static str),
    #[error(transparent)]
    AllTaken(AllTaken),
    #[error("there is nothing here")]
    NotFound,
    #[error("the answer takes too long")]
    TooSlow,
    #[error("{}", .0.body_text())]
    Body(#[from] JsonRejection),
    #[error(transparent)]
    Ask(#[from] AskError),
    #[error("{0}")]
    Io(#[from] io::Error),
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let status = match &self {
            Self::Unauthorized => StatusCode::UNAUTHORIZED,
            Self::Forbidden(_) => StatusCode::FORBIDDEN,
            Self::AllTaken(_) => StatusCode::SERVICE_UNAVAILABLE,
            Self::NotFound => StatusCode::NOT_FOUND,
            Self::TooSlow => StatusCode::GATEWAY_TIMEOUT,
            Self::Body(rejection) => rejection.status(),
            Self::Ask(AskError::Over | AskError::Busy) => StatusCode::SERVICE_UNAVAILABLE,
            Self::Ask(
                AskError::Task(_)
                | AskError::Tasks(_)
                | AskError::Episodes(_)
                | AskError::Setting(_)
                | AskError::Log(_),
            ) => StatusCode::BAD_REQUEST,
            Self::Ask(AskError::Checkpoint(_) | AskError::Panicked(_) | AskError::Lost(_)) | Self::Io(_) => {
                StatusCode::INTERNAL_SERVER_ERROR
            }
        };
        (status, Json(serde_json::json!({ "error": self.to_string() }))).into_response()
    }
}

/// A number of `metrics.jsonl`, and what it is.
#[derive(Serialize)]
struct Measure {
    name: &'static str,
    help: &'static str,
}

/// What stays the same as long as a run goes.
#[derive(Serialize)]
struct Run {
    name: String,
    directory: String,
    version: &'static str,
    task_set: String,
    training_tasks: Vec<String>,
    testing_tasks: Vec<String>,
    has_wins: bool,
    /// What its updates report.
    measures: Vec<Measure>,
    /// Whether some actions are random by an ε.
    explores: bool,
    /// Whether episodes can be drawn.
    has_scenes: bool,
    evaluation_episodes: usize,
    testing_episodes: usize,
    config: String,
}

async fn run(State(page): State<Page>) -> Result<Json<Run>, ApiError> {
    let (config, root) = (page.handle.config(), page.run_dir.root());
    let task_set = config.environment.task_set;
    let names = |split| config.tasks(split).iter().map(Task::to_string).collect();
    Ok(Json(Run {
        name: root.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        directory: root.display().to_string(),
        version: env!("CARGO_PKG_VERSION"),
        task_set: task_set.to_string(),
        training_tasks: names(Split::Training),
        testing_tasks: names(Split::Testing),
        has_wins: task_set.has_wins(),
        explores: config.algorithm.name.facts().regime == Regime::Replay,
        measures: page
            .handle
            .measures()
            .iter()
            .map(|&rit_algo::learner::Measure { name, help }| Measure { name, help })
            .collect(),
        has_scenes: config.tasks(Split::Training).iter().all(|task| task.spec().has_scenes),
        evaluation_episodes: config.evaluation.episodes,
        testing_episodes: config.evaluation.testing_episodes,
        config: read_text(&page.run_dir.config_path())?,
    }))
}

/// How the run stands, for Prometheus, which gives the token as a bearer.
async fn prometheus(State(page): State<Page>) -> Result<Response, ApiError> {
    let text = prometheus::render(page.handle.ask(Control::Status).await?).map_err(io::Error::other)?;
    Ok(([(header::CONTENT_TYPE, prometheus::CONTENT_TYPE)], text).into_response())
}

async fn pause(State(page): State<Page>) -> Result<Json<v1::RunStatus>, ApiError> {
    Ok(Json(page.handle.pause().await?))
}

async fn resume(State(page): State<Page>) -> Result<Json<v1::RunStatus>, ApiError> {
    Ok(Json(page.handle.resume().await?))
}

async fn stop(State(page): State<Page>) -> Result<Json<v1::RunStatus>, ApiError> {
    let stop = |answer| Control::Stop { drain: false, ended: Ended::Stopped, answer };
    Ok(Json(page.handle.ask(stop).await?))
}

async fn checkpoint(State(page): State<Page>) -> Result<Json<v1::CheckpointResponse>, ApiError> {
    Ok(Json(page.handle.checkpoint().await?))
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Evaluate {
    /// `training`, `testing` or names of tasks.
    tasks: Vec<String>,
    /// Of each task; 0 means the run's own number.
    #[serde(default)]
    episodes: u32,
}

async fn evaluate(
    State(page): State<Page>,
    body: Result<Json<Evaluate>, JsonRejection>,
) -> Result<Json<v1::Evaluation>, ApiError> {
    let Json(Evaluate { tasks, episodes }) = body?;
    Ok(Json(page.handle.evaluate(v1::EvaluateRequest { tasks, episodes, seed: None }).await?))
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Watch {
    task: String,
    /// Which of the episodes that evaluations of the task roll.
    number: u32,
}

/// One greedy episode, agents in the environment's own order: with n agents and T steps.
#[derive(Serialize)]
struct Shown {
    task: String,
    number: u32,
    weights_version: u64,
    env_steps: u64,
    /// `[n]`, the agent that decides first, second, …
    decision_order: Vec<u8>,
    /// `[T][n]`, by agent.
    actions: Vec<Vec<Action>>,
    /// `[T]`.
    rewards: Vec<f32>,
    /// `None` where the task knows no winning.
    won: Option<bool>,
    /// `[T + 1][m]`, agents first; empty where entities have no places.
    scenes: Vec<Vec<ShownBody>>,
    /// `[T + 1]`: what bodies did to each other in the step before each scene.
    links: Vec<Vec<ShownLink>>,
    /// Where each action of the task pushes or sends its agent; empty where entities have no places.
    pushes: Vec<[f32; 2]>,
}

#[derive(Serialize)]
struct ShownBody {
    kind: &'static str,
    x: f32,
    y: f32,
    radius: f32,
    /// Of a unit in combat.
    #[serde(skip_serializing_if = "Option::is_none")]
    unit: Option<ShownUnit>,
}

#[derive(Serialize)]
struct ShownUnit {
    letter: char,
    health: f32,
    shield: Option<f32>,
}

/// Who did something to whom, by index.
#[derive(Serialize)]
struct ShownLink {
    from: usize,
    to: usize,
    heals: bool,
}

async fn watch(
    State(page): State<Page>,
    body: Result<Json<Watch>, JsonRejection>,
) -> Result<Json<Shown>, ApiError> {
    let Json(Watch { task, number }) = body?;
    let Watched { snapshot, episode, scenes } = page.handle.watch(&task, number.into()).await?;
    let by_agent = |row_actions: &[Action]| {
        let mut actions = vec![0; episode.n_agents];
        for (&agent, &action) in episode.decision_order.iter().zip(row_actions) {
            actions[usize::from(agent)] = action;
        }
        actions
    };
    let config = page.handle.config();
    let task_set = config.environment.task_set;
    let has_wins = task_set.has_wins();
    let pushes = task_set.task(&task).map_or_else(
        |_| Vec::new(),
        |task| (0..task.spec().n_actions).filter_map(|action| task.direction(action as Action)).collect(),
    );
    Ok(Json(Shown {
        task,
        number,
        weights_version: snapshot.version,
        env_steps: snapshot.env_steps,
        actions: episode.actions.chunks_exact(episode.n_agents).map(by_agent).collect(),
        won: has_wins.then_some(episode.won),
        scenes: scenes.iter().map(shown).collect(),
        links: scenes.iter().map(shown_links).collect(),
        pushes,
        decision_order: episode.decision_order,
        rewards: episode.rewards,
    }))
}

fn shown_links(scene: &Scene) -> Vec<ShownLink> {
    let link =
        |link: &SceneLink| ShownLink { from: link.from, to: link.to, heals: link.kind == LinkKind::Heal };
    scene.links.iter().map(link).collect()
}

fn shown(scene: &Scene) -> Vec<ShownBody> {
    let bodies = scene.bodies.iter().map(|body| ShownBody {
        kind: match body.kind {
            BodyKind::Agent => "agent",
            BodyKind::Landmark => "landmark",
            BodyKind::Prey => "prey",
            BodyKind::Enemy => "enemy",
        },
        x: body.x,
        y: body.y,
        radius: body.radius,
        unit: body.unit.map(|unit| ShownUnit {
            letter: unit.letter,
            health: unit.health,
            shield: unit.shield,
        }),
    });
    bodies.collect()
}

#[derive(Deserialize)]
struct Log {
    process: String,
}

/// The end of one process's log, and which processes have one.
#[derive(Serialize)]
struct LogTail {
    processes: Vec<String>,
    text: String,
}

async fn log(
    State(page): State<Page>,
    Query(Log { process }): Query<Log>,
) -> Result<Json<LogTail>, ApiError> {
    let logs = page.run_dir.logs();
    let mut processes = Vec::new();
    for entry in fs::read_dir(&logs)? {
        let name = entry?.file_name().to_string_lossy().into_owned();
        processes.extend(name.strip_suffix(".log").map(str::to_owned));
    }
    processes.sort_by_key(|name| (name != "learner", name.len(), name.clone()));
    // Only what lies there is read: the name that was asked for may be a path.
    let text = match processes.contains(&process) {
        true => tail(&logs.join(format!("{process}.log")))?,
        false => return Err(ApiError::NotFound),
    };
    Ok(Json(LogTail { processes, text }))
}

/// The last whole lines of a file.
fn tail(path: &Path) -> io::Result<String> {
    let mut file = open_regular(path, OpenOptions::new().read(true))?;
    let skipped = file.metadata()?.len().saturating_sub(LOG_BYTES);
    file.seek(SeekFrom::Start(skipped))?;
    let mut bytes = Vec::new();
    file.take(LOG_BYTES).read_to_end(&mut bytes)?;
    let text = String::from_utf8_lossy(&bytes);
    Ok(match text.split_once('\n') {
        Some((_, whole)) if skipped > 0 => whole.to_owned(),
        _ => text.into_owned(),
    })
}
