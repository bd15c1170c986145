//! What callers ask of a running learner, whichever way they come: the gRPC service and the web page share it.

use crate::{
    coordinator::{Control, Event, Input},
    evaluation::{Evaluator, TasksError},
    messages,
    trainer::{Checkpointed, News, evaluation_seed},
    weights::{Snapshot, WeightsBoard},
};
use rit_algo::{Acting, Model, learner::Measure};
use rit_config::{Config, ConfigError, RunDir, set, set_live, write_whole};
use rit_env::{EnvironmentFactory, Scene, TaskError, rollout::LostEpisode};
use rit_episode::{Episode, RunSeed};
use rit_proto::v1;
use std::{
    fs,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};
use tokio::{
    sync::{Mutex, Semaphore, mpsc, oneshot, watch},
    task::JoinError,
};
use tracing::Instrument as _;

/// Most episodes of each task that one evaluation rolls.
pub const EPISODES_MAX: u32 = 1_000_000;

/// Evaluations and episodes to watch that are under way or wait for their turn, at most.
const WAITING_MAX: usize = 8;

/// Changes what this process logs, or says why it cannot.
pub type SetLog = Arc<dyn Fn(&str) -> Result<(), String> + Send + Sync>;

/// Why a question has no answer.
#[derive(Debug, thiserror::Error)]
pub enum AskError {
    /// The learner's threads have gone.
    #[error("the run is over")]
    Over,
    /// No such task.
    #[error(transparent)]
    Task(#[from] TaskError),
    /// No such tasks.
    #[error(transparent)]
    Tasks(#[from] TasksError),
    /// An environment could not go on.
    #[error(transparent)]
    Lost(#[from] LostEpisode),
    /// More episodes than a person would wait for.
    #[error("{0} episodes of a task are too many: at most {EPISODES_MAX}")]
    Episodes(u32),
    /// A setting that cannot be.
    #[error(transparent)]
    Setting(#[from] ConfigError),
    /// A filter for logs that means nothing.
    #[error("log: {0}")]
    Log(String),
    /// The checkpoint was not written.
    #[error("{0}")]
    Checkpoint(String),
    /// Others wait for their turn.
    #[error("{WAITING_MAX} evaluations are under way or wait for their turn; try again later")]
    Busy,
    /// What was to be done panicked.
    #[error("it was not done: {0}; this is a fault of the program, its message is in the log")]
    Panicked(#[from] JoinError),
}

/// One greedy episode, and what could be seen of it.
#[derive(Debug)]
pub struct Watched {
    /// The weights that rolled it.
    pub snapshot: Arc<Snapshot>,
    /// What was done and earned.
    pub episode: Episode,
    /// The world at its beginning and after each step; nothing where the entities have no places.
    pub scenes: Vec<Scene>,
}

/// A way to speak to a running learner.
#[derive(Clone)]
pub struct RunHandle {
    events: mpsc::Sender<Event>,
    board: Arc<WeightsBoard>,
    config: watch::Sender<Arc<Config>>,
    /// One change of it at a time.
    setting: Arc<Mutex<()>>,
    run_dir: RunDir,
    set_log: SetLog,
    model: Arc<Model>,
    measures: &'static [Measure],
    /// Worlds for evaluations that are asked for.
    factory: Arc<dyn EnvironmentFactory>,
    /// One caller's episodes at a time: training goes on beside them.
    rollouts: Arc<Semaphore>,
    /// Room for those who wait for their turn.
    waiting: Arc<Semaphore>,
}

/// The caller: gone when this is dropped.
struct Asking(Arc<AtomicBool>);

impl Drop for Asking {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

impl RunHandle {
    /// Speaks to the coordinator by `events`, and evaluates the weights on the board.
    pub fn new(
        events: mpsc::Sender<Event>,
        board: Arc<WeightsBoard>,
        config: Config,
        run_dir: RunDir,
        model: Arc<Model>,
        measures: &'static [Measure],
        set_log: SetLog,
    ) -> Self {
        let (setting, factory) = (Arc::default(), rit_worlds::factory(&config));
        let config = watch::Sender::new(Arc::new(config));
        Self {
            events,
            board,
            config,
            setting,
            run_dir,
            set_log,
            model,
            measures,
            factory,
            rollouts: Arc::new(Semaphore::new(1)),
            waiting: Arc::new(Semaphore::new(WAITING_MAX)),
        }
    }

    /// What the run's updates report.
    pub fn measures(&self) -> &'static [Measure] {
        self.measures
    }

    /// The run's configuration as it is now.
    pub fn config(&self) -> Arc<Config> {
        Arc::clone(&self.config.borrow())
    }

    /// Changes settings while the run goes on, and writes them into the run directory; all of it or nothing, whether or not
    /// the caller stays.
    ///
    /// # Errors
    /// When a setting is wrong or cannot change now, or when the run is over.
    pub async fn set(&self, request: v1::SetRequest) -> Result<v1::RunStatus, AskError> {
        let run = self.clone();
        to_its_end(async move { run.set_now(request).await }).await
    }

    async fn set_now(&self, request: v1::SetRequest) -> Result<v1::RunStatus, AskError> {
        let v1::SetRequest { settings, log } = request;
        let _one_at_a_time = self.setting.lock().await;
        let tables: Vec<_> =
            settings.iter().map(|(key, value)| set(&format!("{key}={value}"))).collect::<Result<_, _>>()?;
        let config = Arc::new(set_live(&self.config(), &tables)?);
        if !log.is_empty() {
            (self.set_log)(&log).map_err(AskError::Log)?;
        }
        let status = self.ask(|answer| Control::Set(Arc::clone(&config), answer)).await?;
        self.config.send_replace(Arc::clone(&config));
        tracing::info!(?settings, log, "settings changed");
        // A full disk may be why settings change: `checkpoints.rescue_dir` is of use then.
        if let Err(error) = self.run_dir.write_config(&config) {
            let what = format!(
                "settings were changed and could not be written down: {error}; set them again later, or a resumed run \
                 will not have them"
            );
            self.warn(what).await;
        }
        Ok(status)
    }

    /// Pauses the run. If this learner is killed, the next one is paused too.
    ///
    /// # Errors
    /// When the run is over.
    pub async fn pause(&self) -> Result<v1::RunStatus, AskError> {
        let run = self.clone();
        to_its_end(async move { run.pause_now().await }).await
    }

    async fn pause_now(&self) -> Result<v1::RunStatus, AskError> {
        let _one_at_a_time = self.setting.lock().await;
        let status = self.ask(Control::Pause).await?;
        // A run that is stopping is not paused. A full disk may be why a run is paused: it is paused all the same.
        if status.state() == v1::RunState::Paused
            && let Err(error) = write_whole(&self.run_dir.paused(), b"")
        {
            let path = self.run_dir.paused();
            let what = format!(
                "{}: {error}; if the learner is killed now, the next one will not be paused",
                path.display()
            );
            self.warn(what).await;
        }
        Ok(status)
    }

    /// Warns the person who runs it.
    async fn warn(&self, what: String) {
        tracing::warn!("{what}");
        // When the run is over, the log has it.
        let _ = self.events.send(Input::News(News::Warning(what)).into()).await;
    }

    /// Resumes a run that is paused.
    ///
    /// # Errors
    /// When the run is over.
    pub async fn resume(&self) -> Result<v1::RunStatus, AskError> {
        let run = self.clone();
        to_its_end(async move {
            let _one_at_a_time = run.setting.lock().await;
            // Most often it is there; without it the next learner would not be paused either.
            let _ = fs::remove_file(run.run_dir.paused());
            run.ask(Control::Resume).await
        })
        .await
    }

    /// Asks the coordinator.
    ///
    /// # Errors
    /// When the run is over.
    pub async fn ask<T>(&self, question: impl FnOnce(oneshot::Sender<T>) -> Control) -> Result<T, AskError> {
        let (answer, answered) = oneshot::channel();
        self.events.send(Event::Control(question(answer))).await.map_err(|_| AskError::Over)?;
        answered.await.map_err(|_| AskError::Over)
    }

    /// Waits until no more answers come.
    pub async fn over(&self) {
        self.events.closed().await;
    }

    /// Writes a checkpoint, and answers when it is on disk.
    ///
    /// # Errors
    /// When the run is over or the checkpoint cannot be written.
    pub async fn checkpoint(&self) -> Result<v1::CheckpointResponse, AskError> {
        let Checkpointed { progress, weights_digest, written } = self.ask(Control::Checkpoint).await?;
        let written = written.await.map_err(|_| AskError::Over)?;
        let path = written.map_err(AskError::Checkpoint)?;
        let (path, env_steps) = (path.display().to_string(), progress.env_steps);
        Ok(v1::CheckpointResponse { path, env_steps, weights_digest })
    }

    /// Greedy episodes with the newest weights, while training goes on.
    ///
    /// # Errors
    /// When there are no such tasks, or too many episodes are asked for.
    pub async fn evaluate(&self, request: v1::EvaluateRequest) -> Result<v1::Evaluation, AskError> {
        let v1::EvaluateRequest { tasks, episodes, seed } = request;
        let config = self.config();
        let evaluator = Evaluator::with_factory(&config, Arc::clone(&self.factory));
        let tasks = evaluator.tasks(&tasks)?;
        let episodes = match episodes {
            0 => None,
            1..=EPISODES_MAX => Some(episodes as usize),
            _ => return Err(AskError::Episodes(episodes)),
        };
        let seed = seed.map_or_else(|| evaluation_seed(&config), RunSeed);
        let evaluation = self.roll(move |acting, snapshot, given_up| {
            let results = evaluator.evaluate_unless(&mut [acting], &tasks, episodes, seed, given_up)?;
            Ok::<_, AskError>(results.map(|results| v1::Evaluation {
                env_steps: snapshot.env_steps,
                weights_version: snapshot.version,
                tasks: results.iter().map(messages::task_result).collect(),
            }))
        });
        // What was given up has no caller to answer.
        evaluation.await??.ok_or(AskError::Over)
    }

    /// The episode of this number of the run's own evaluation of a task, rolled with the newest weights.
    ///
    /// # Errors
    /// When there is no such task.
    pub async fn watch(&self, task: &str, number: u64) -> Result<Watched, AskError> {
        let config = self.config();
        let evaluator = Evaluator::with_factory(&config, Arc::clone(&self.factory));
        let task = config.environment.task_set.task(task)?;
        let seed = evaluation_seed(&config);
        self.roll(move |acting, snapshot, _| {
            let (mut scenes, one) = (Vec::new(), number..number + 1);
            let mut episodes =
                evaluator.watch(acting, task, one, seed, |_, world| scenes.extend(world.scene()))?;
            // One number, one episode.
            Ok(Watched { snapshot: Arc::clone(snapshot), episode: episodes.swap_remove(0), scenes })
        })
        .await?
    }

    /// Rolls with the newest weights on a thread of its own. When the caller has gone, `work` is told by its last
    /// argument to give up.
    async fn roll<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Acting, &Arc<Snapshot>, &(dyn Fn() -> bool + Sync)) -> T + Send + 'static,
    ) -> Result<T, AskError> {
        let room = Arc::clone(&self.waiting).try_acquire_owned().map_err(|_| AskError::Busy)?;
        let turn = Arc::clone(&self.rollouts).acquire_owned().await.map_err(|_| AskError::Over)?;
        let (snapshot, model) = (self.board.newest(), Arc::clone(&self.model));
        let gone = Arc::new(AtomicBool::new(false));
        // Dropped with this future, which is when the caller's connection or deadline ends.
        let _asking = Asking(Arc::clone(&gone));
        let rolled = tokio::task::spawn_blocking(move || {
            let _places = (turn, room);
            let given_up = || gone.load(Ordering::Relaxed);
            work(&mut Acting::new(&model, &snapshot.to_params()), &snapshot, &given_up)
        });
        Ok(rolled.await?)
    }
}

/// Does something to its end though its caller hangs up, which drops this future: what belongs together is done together.
async fn to_its_end<T: Send + 'static>(
    work: impl Future<Output = Result<T, AskError>> + Send + 'static,
) -> Result<T, AskError> {
    tokio::spawn(work.in_current_span()).await?
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_config::OwnedRunDir;

    struct Run {
        _folder: tempfile::TempDir,
        run_dir: RunDir,
        handle: RunHandle,
        /// What reaches the coordinator.
        events: mpsc::Receiver<Event>,
    }

    fn run() -> Run {
        let config = rit_config::resolve("environment.task_set = 'matrix-game'", "test", &[]).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let run_dir = OwnedRunDir::create(&folder.path().join("run"), &config).unwrap().run_dir().clone();
        let model = Arc::new(Model::new(config.model()).unwrap());
        let board = Arc::new(WeightsBoard::new(Snapshot::new(0, 0, &[]), 0));
        let (to_coordinator, events) = mpsc::channel(8);
        let set_log: SetLog = Arc::new(|_: &str| Ok(()));
        let handle = RunHandle::new(to_coordinator, board, config, run_dir.clone(), model, &[], set_log);
        Run { _folder: folder, run_dir, handle, events }
    }

    fn request(key: &str, value: &str) -> v1::SetRequest {
        v1::SetRequest { settings: [(key.to_owned(), value.to_owned())].into(), log: String::new() }
    }

    /// The settings that the coordinator is told, and the way to answer.
    async fn told(events: &mut mpsc::Receiver<Event>) -> (Arc<Config>, oneshot::Sender<v1::RunStatus>) {
        match events.recv().await {
            Some(Event::Control(Control::Set(config, answer))) => (config, answer),
            other => panic!("{other:?}"),
        }
    }

    #[tokio::test]
    async fn a_caller_that_hangs_up_takes_no_setting_back() {
        let Run { _folder, handle, mut events, .. } = run();
        let caller = handle.clone();
        let first = tokio::spawn(async move { caller.set(request("checkpoints.last_retry_ms", "5")).await });
        let (_, answer) = told(&mut events).await;
        first.abort();
        assert!(first.await.unwrap_err().is_cancelled());
        answer.send(v1::RunStatus::default()).unwrap();
        let second =
            tokio::spawn(async move { handle.set(request("checkpoints.every_env_steps", "500")).await });
        let (config, answer) = told(&mut events).await;
        let checkpoints = &config.checkpoints;
        assert_eq!((checkpoints.last_retry_ms, checkpoints.every_env_steps), (5, 500));
        answer.send(v1::RunStatus::default()).unwrap();
        second.await.unwrap().unwrap();
    }

    #[tokio::test]
    async fn settings_change_though_they_cannot_be_written_down() {
        let Run { _folder, run_dir, handle, mut events } = run();
        // A file is not prepared where a folder lies.
        fs::create_dir(run_dir.root().join("config.partial")).unwrap();
        let before = fs::read(run_dir.root().join("config.toml")).unwrap();
        // Without an answer the handle is dropped, which closes the channel.
        let set = tokio::spawn(async move {
            let changed = handle.set(request("checkpoints.rescue_dir", "/elsewhere")).await;
            changed.map(|_| handle)
        });
        let (config, answer) = told(&mut events).await;
        assert_eq!(config.checkpoints.rescue_dir, "/elsewhere");
        answer.send(v1::RunStatus::default()).unwrap();
        let handle = set.await.unwrap().unwrap();
        assert_eq!(handle.config().checkpoints.rescue_dir, "/elsewhere");
        let warned = events.recv().await;
        let Some(Event::Input(Input::News(News::Warning(what)))) = warned else { panic!("{warned:?}") };
        assert!(what.contains("config.toml") && what.contains("set them again later"), "{what}");
        assert_eq!(fs::read(run_dir.root().join("config.toml")).unwrap(), before);
    }
}
