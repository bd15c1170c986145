//! A learner process from its beginning to its end.

mod doors;
#[cfg(test)]
mod tests;
mod threads;

use crate::{
    checkpoint::{self, CheckpointError, Loaded},
    control_service::ControlService,
    coordinator::{Coordinator, Event, Input, Shell},
    cpu_time::CpuTime,
    episodes_service::EpisodesService,
    initial::{InitialError, initial_params},
    life::{self, EndOfLife, LifeError},
    replay_log::{ReplayLog, ReplayLogError},
    rollout_service::RolloutService,
    run_handle::{RunHandle, SetLog},
    trainer::{Algorithm, Made, TrainError, Trainer},
    web::WebError,
    weights::WeightsService,
    write_queue::write_queue,
    writer::Writer,
};
use doors::Doors;
use rit_algo::{ConfigError, Learner, Model};
use rit_config::{Config, RunDir};
use rit_env::Split;
use rit_episode::wire::{Expected, PayloadLayout};
use rit_ipc::{CreateError, EpisodeReceiver, Limits, ReceiveError};
use rit_policy::TaskNames;
use rit_proto::{
    transport::{AccessError, AddressError, ListenError, REQUEST_BYTES_MAX},
    v1::{
        Welcome, control_server::ControlServer, episodes_server::EpisodesServer,
        rollout_server::RolloutServer, weights_server::WeightsServer,
    },
};
use rit_record::{Build, Ended, Summary};
use std::{
    fs, io,
    sync::{Arc, mpsc},
};
use threads::Workers;
use tokio::sync::mpsc as async_mpsc;
use tonic::service::Routes;

/// Events that may wait for the coordinator.
const EVENT_QUEUE: usize = 1024;

/// Why a learner ended early, or did not begin.
#[derive(Debug, thiserror::Error)]
pub enum LearnerError {
    /// The configuration names no address.
    #[error("learner.listen: {0}")]
    Address(#[from] AddressError),
    /// It would let in whom it should not.
    #[error(transparent)]
    Access(#[from] AccessError),
    /// The configuration cannot be told to actors.
    #[error(transparent)]
    Config(#[from] rit_config::ConfigError),
    /// It cannot listen.
    #[error(transparent)]
    Listen(#[from] ListenError),
    /// The web page cannot be served.
    #[error(transparent)]
    Web(#[from] WebError),
    /// There is no place for shared memory.
    #[error(transparent)]
    Life(#[from] LifeError),
    /// Shared memory cannot be had.
    #[error(transparent)]
    SharedMemory(#[from] CreateError),
    /// Shared memory failed.
    #[error(transparent)]
    Receive(#[from] ReceiveError),
    /// The configuration makes no model.
    #[error(transparent)]
    Model(#[from] ConfigError),
    /// The weights that it begins with cannot be had.
    #[error(transparent)]
    Initial(#[from] InitialError),
    /// There are checkpoints and none can be used.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// Replay on disk cannot be continued.
    #[error(transparent)]
    Replay(#[from] ReplayLogError),
    /// Training failed.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// A file of the run directory or a thread could not be had.
    #[error("{what}: {error}")]
    Io {
        /// The file or thread.
        what: String,
        /// Why.
        error: io::Error,
    },
    /// A thread panicked.
    #[error("the {0} thread panicked; this is a fault of the program, its message is in the log")]
    Panicked(&'static str),
}

/// Runs a learner until T_max, until it is told to stop, or until `shutdown` resolves. `build` is this program, for the
/// run's record; `set_log` changes what it logs.
///
/// # Errors
/// When it cannot begin, or training fails.
pub async fn run(
    run_dir: RunDir,
    config: Config,
    build: Build,
    set_log: SetLog,
    shutdown: impl Future<Output = ()>,
) -> Result<Summary, LearnerError> {
    let doors = Doors::open(&run_dir, &config).await?;
    let _end_of_life = EndOfLife(&run_dir);
    let Parts { events, event_queue, coordinator, services, workers } =
        Parts::build(&run_dir, config, build, set_log)?;
    pause_again(&run_dir, &events).await;
    let threads = workers.spawn(&run_dir, &events)?;
    let ControlService { run: handle, metrics } = services.control.clone();
    let serving = doors.serve(&run_dir, &services.routes().await, handle, metrics)?;

    coordinate(coordinator.run(event_queue), &events, shutdown).await;

    threads.stop_receiving();
    serving.end().await;
    for file in [run_dir.address(), run_dir.remote_address(), run_dir.paused()] {
        let _ = fs::remove_file(file);
    }
    threads.end(&run_dir).await
}

/// All parts of a learner, none of them at work.
struct Parts {
    /// Leads to the coordinator.
    events: async_mpsc::Sender<Event>,
    event_queue: async_mpsc::Receiver<Event>,
    coordinator: Shell,
    services: Services,
    workers: Workers,
}

impl Parts {
    /// Builds them, with the newest checkpoint, and joins them by their queues.
    fn build(run_dir: &RunDir, config: Config, build: Build, set_log: SetLog) -> Result<Self, LearnerError> {
        let algorithm = algorithm(run_dir, &config)?;
        let (model, measures) = (Arc::clone(&algorithm.model), algorithm.learner.measures());
        let expected = Arc::new(expected(run_dir, &config));
        let limits = Limits::new(expected.layout.len(), config.actors.count.max(config.actors.count_max));
        let (receiver, notice) = new_receiver(run_dir, limits)?;
        let (events, event_queue) = async_mpsc::channel(EVENT_QUEUE);
        let (to_trainer, work) = mpsc::channel();
        let (to_receiver, fences) = mpsc::channel();
        let (write, to_write) = write_queue(config.replay_episodes());

        // Of a copied run, replay and checkpoints are the first one's.
        let logged = Expected { run_id: run_dir.lineage(), ..Expected::clone(&expected) };
        let loaded = load(run_dir, &*algorithm.learner, &logged, &config)?;
        let writer = writer(run_dir, &config, &model, &logged, loaded.as_ref(), events.clone())?;
        let cpu = Arc::new(CpuTime::default());
        let made = Made { build, cpu: Arc::clone(&cpu) };
        let news = events.clone();
        let news = Box::new(move |what| {
            // Without a coordinator the run is over.
            let _ = news.blocking_send(Input::News(what).into());
        });
        let (trainer, board) =
            Trainer::new(config.clone(), run_dir.clone(), algorithm, loaded, news, write, made)?;

        let welcome = Welcome { actor: 0, run_id: run_dir.run_id().to_vec(), config: config.to_toml()? };
        let mut beginning = trainer.beginning();
        beginning.warnings.extend(notice);
        let coordinator = Coordinator::new(config.clone(), beginning);
        let coordinator = Shell::new(coordinator, welcome, to_trainer, to_receiver);
        let (to_run, run_dir) = (events.clone(), run_dir.clone());
        let run = RunHandle::new(to_run, board.clone(), config, run_dir, model, measures, set_log);
        let services = Services {
            weights: WeightsService(board),
            rollout: RolloutService { events: events.clone(), cpu },
            episodes: EpisodesService { events: events.clone(), expected: Arc::clone(&expected) },
            control: ControlService { run, metrics: trainer.metrics_follower() },
        };
        let workers = Workers { receiver, limits, expected, fences, writer, to_write, trainer, work };
        Ok(Self { events, event_queue, coordinator, services, workers })
    }
}

/// The model, and the algorithm with the weights that a run begins with.
fn algorithm(run_dir: &RunDir, config: &Config) -> Result<Algorithm, LearnerError> {
    let model = Arc::new(Model::new(config.model())?);
    let params = initial_params(run_dir, config, &model)?;
    let learner = model.learner(config.update(), params).map_err(|error| LearnerError::Io {
        what: "the update's threads".into(),
        error: io::Error::other(error),
    })?;
    Ok(Algorithm { model, learner })
}

/// The writer, which continues where the checkpoint was written that was loaded.
fn writer(
    run_dir: &RunDir,
    config: &Config,
    model: &Arc<Model>,
    logged: &Expected,
    loaded: Option<&Loaded>,
    events: async_mpsc::Sender<Event>,
) -> Result<Writer, LearnerError> {
    let episodes = loaded.map_or(0, |loaded| loaded.state.manifest.progress.episodes);
    Ok(Writer {
        run_dir: run_dir.clone(),
        model: Arc::clone(model),
        names: TaskNames::of(config),
        log: ReplayLog::open(&run_dir.replay(), logged.layout, logged.run_id, episodes)?,
        replay_episodes: config.replay_episodes(),
        keep: config.checkpoints.keep,
        events,
    })
}

/// What the learner answers over gRPC.
struct Services {
    weights: WeightsService,
    rollout: RolloutService,
    episodes: EpisodesService,
    control: ControlService,
}

impl Services {
    /// All of them, and their health.
    async fn routes(self) -> Routes {
        let (health_reporter, health) = tonic_health::server::health_reporter();
        health_reporter.set_serving::<WeightsServer<WeightsService>>().await;
        health_reporter.set_serving::<RolloutServer<RolloutService>>().await;
        health_reporter.set_serving::<EpisodesServer<EpisodesService>>().await;
        health_reporter.set_serving::<ControlServer<ControlService>>().await;
        let episode_bytes_max = self.episodes.message_bytes_max();
        let weights = WeightsServer::new(self.weights).max_decoding_message_size(REQUEST_BYTES_MAX);
        let rollout = RolloutServer::new(self.rollout).max_decoding_message_size(REQUEST_BYTES_MAX);
        let episodes = EpisodesServer::new(self.episodes).max_decoding_message_size(episode_bytes_max);
        let control = ControlServer::new(self.control).max_decoding_message_size(REQUEST_BYTES_MAX);
        Routes::new(health)
            .add_service(weights)
            .add_service(rollout)
            .add_service(episodes)
            .add_service(control)
    }
}

/// Pauses a run whose learner was killed while it was paused: the first event, so no episode is handed out before it.
async fn pause_again(run_dir: &RunDir, events: &async_mpsc::Sender<Event>) {
    if run_dir.paused().is_file() {
        let _ = events.send(Input::Pause.into()).await;
    }
}

/// Coordinates until the run is over. `shutdown` interrupts it.
async fn coordinate(
    coordinating: impl Future<Output = ()>,
    events: &async_mpsc::Sender<Event>,
    shutdown: impl Future<Output = ()>,
) {
    tokio::pin!(coordinating, shutdown);
    tokio::select! {
        () = &mut coordinating => {}
        () = &mut shutdown => {
            let interrupt = Input::Stop { drain: false, ended: Ended::Interrupted };
            // Where the queue is full, there is room once the coordinator has taken something out of it.
            let _ = tokio::join!(events.send(interrupt.into()), coordinating);
        }
    }
}

/// A receiver in a place of its own; the second value says where that is not where it should be.
fn new_receiver(run_dir: &RunDir, limits: Limits) -> Result<(EpisodeReceiver, Option<String>), LearnerError> {
    let (space, notice) = life::begin(run_dir)?;
    notice.iter().for_each(|notice| tracing::warn!("{notice}"));
    Ok((EpisodeReceiver::create(&space, limits)?, notice))
}

/// What every episode of this run must look like.
pub fn expected(run_dir: &RunDir, config: &Config) -> Expected {
    Expected {
        run_id: run_dir.run_id(),
        layout: PayloadLayout::new(config.dims()),
        tasks: config.tasks(Split::Training).into_iter().map(rit_env::Task::size).collect(),
    }
}

/// The newest checkpoint that can be used, if any was ever written.
fn load(
    run_dir: &RunDir,
    learner: &dyn Learner,
    expected: &Expected,
    config: &Config,
) -> Result<Option<Loaded>, LearnerError> {
    let loaded = checkpoint::load_newest(run_dir, learner, expected, config)?;
    if let Some(Loaded { folder, state, warnings, .. }) = &loaded {
        warnings.iter().for_each(|warning| tracing::warn!("{warning}"));
        let (folder, env_steps) = (folder.display(), state.manifest.progress.env_steps);
        tracing::info!(%folder, env_steps, "going on from a checkpoint");
    }
    Ok(loaded)
}
