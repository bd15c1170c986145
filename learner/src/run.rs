//! A learner process from its beginning to its end.

use crate::{
    checkpoint::{self, CheckpointError, Loaded},
    control_service::ControlService,
    coordinator::{Coordinator, Event},
    receive::receive,
    replay_log::{ReplayLog, ReplayLogError},
    rollout_service::RolloutService,
    trainer::{Summary, TrainError, Trainer},
    weights::WeightsService,
    writer::Writer,
};
use rit_algo::{ConfigError, Rit};
use rit_config::{Config, RunDir};
use rit_env::Split;
use rit_episode::wire::{Expected, PayloadLayout};
use rit_ipc::{CreateError, EpisodeReceiver, Limits, ReceiveError, RunSpace, RunSpaceError};
use rit_proto::{
    MESSAGE_BYTES_MAX,
    transport::{Address, AddressError, Guard, Incoming, ListenError},
    v1::{control_server::ControlServer, rollout_server::RolloutServer, weights_server::WeightsServer},
};
use std::{
    fs, io,
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc,
    },
    thread,
    time::Duration,
};
use tokio::sync::{mpsc as async_mpsc, oneshot};
use tonic::{service::interceptor::InterceptedService, transport::Server};

/// Events that may wait for the coordinator.
const EVENT_QUEUE: usize = 1024;

/// How long the end of a run waits for connections to close.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(1);

/// Why a learner ended early, or did not begin.
#[derive(Debug, thiserror::Error)]
pub enum LearnerError {
    /// The configuration names no address.
    #[error("learner.listen: {0}")]
    Address(#[from] AddressError),
    /// It cannot listen.
    #[error(transparent)]
    Listen(#[from] ListenError),
    /// The run directory is no place for shared memory.
    #[error(transparent)]
    RunSpace(#[from] RunSpaceError),
    /// Shared memory cannot be had.
    #[error(transparent)]
    SharedMemory(#[from] CreateError),
    /// Shared memory failed.
    #[error(transparent)]
    Receive(#[from] ReceiveError),
    /// The configuration makes no model.
    #[error(transparent)]
    Model(#[from] ConfigError),
    /// There are checkpoints and none can be used.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// Replay on disk cannot be continued.
    #[error(transparent)]
    Replay(#[from] ReplayLogError),
    /// Training failed.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// The services failed.
    #[error("the gRPC services failed: {0}")]
    Serve(#[from] tonic::transport::Error),
    /// A file of the run directory or a thread could not be had.
    #[error("{what}: {error}")]
    Io {
        /// The file or thread.
        what: String,
        /// Why.
        error: io::Error,
    },
    /// A thread ended without a word.
    #[error("the {0} thread panicked; this is a fault of the program, its message is in the log")]
    Panicked(&'static str),
}

/// Runs a learner until T_max, until it is told to stop, or until `shutdown`, which means the same.
///
/// # Errors
/// When it cannot begin, or training fails.
pub async fn run(
    run_dir: RunDir,
    config: Config,
    shutdown: impl Future<Output = ()>,
) -> Result<Summary, LearnerError> {
    let address = match config.learner.listen.as_str() {
        "unix" => Address::Unix(run_dir.socket()),
        address => address.parse()?,
    };
    let incoming = Incoming::bind(&address).await?;
    let rit = Arc::new(Rit::new(config.rit())?);
    let expected = expected(&run_dir, &config);
    let space = RunSpace::new(&run_dir.shared_memory_root())?;
    let receiver = EpisodeReceiver::create(&space, Limits::new(expected.layout.len(), config.actors.count))?;

    let (events, event_queue) = async_mpsc::channel(EVENT_QUEUE);
    let (work, work_queue) = mpsc::channel();
    let (fences, fence_queue) = mpsc::channel();
    let news = events.clone();
    let news = Box::new(move |what| {
        let _ = news.blocking_send(Event::News(what));
    });
    let loaded = load(&run_dir, &rit, &expected, config.algorithm.buffer_size)?;
    let episodes = loaded.as_ref().map_or(0, |loaded| loaded.state.manifest.progress.episodes);
    let writer = Writer {
        run_dir: run_dir.clone(),
        rit: Arc::clone(&rit),
        log: ReplayLog::open(&run_dir.replay(), expected.layout, run_dir.run_id(), episodes)?,
        buffer_size: config.algorithm.buffer_size,
        keep: config.checkpoints.keep,
        events: events.clone(),
    };
    let (to_write, write_queue) = mpsc::channel();
    let (trainer, board) =
        Trainer::new(config.clone(), run_dir.clone(), Arc::clone(&rit), loaded, news, to_write)?;
    let metrics = trainer.metrics_follower();
    let coordinator = Coordinator::new(config.clone(), trainer.beginning(), work, fences);

    let stop = Arc::new(AtomicBool::new(false));
    let receiving = {
        let (events, stop) = (events.clone(), Arc::clone(&stop));
        spawn("receive", move || {
            let result = receive(receiver, &expected, &events, &fence_queue, &stop);
            let _ = events.blocking_send(Event::Over);
            result
        })?
    };
    let writing = spawn("write", move || writer.run(&write_queue))?;
    let training = {
        let events = events.clone();
        spawn("train", move || {
            let result = trainer.run(&work_queue);
            let _ = events.blocking_send(Event::Over);
            result
        })?
    };

    let guard = Guard::new(run_dir.token());
    let weights =
        WeightsServer::new(WeightsService(Arc::clone(&board))).max_encoding_message_size(MESSAGE_BYTES_MAX);
    let control = ControlService::new(events.clone(), board, metrics, Arc::new(config), rit);
    let (health_reporter, health) = tonic_health::server::health_reporter();
    health_reporter.set_serving::<WeightsServer<WeightsService>>().await;
    health_reporter.set_serving::<RolloutServer<RolloutService>>().await;
    health_reporter.set_serving::<ControlServer<ControlService>>().await;
    write_address(&run_dir, &incoming)?;
    let (close, closed) = oneshot::channel::<()>();
    let server = Server::builder()
        .add_service(health)
        .add_service(InterceptedService::new(weights, guard.clone()))
        .add_service(InterceptedService::new(
            RolloutServer::new(RolloutService(events.clone())),
            guard.clone(),
        ))
        .add_service(InterceptedService::new(ControlServer::new(control), guard))
        .serve_with_incoming_shutdown(incoming, async {
            let _ = closed.await;
        });
    let server = tokio::spawn(server);
    tracing::info!(%address, "the learner listens");

    let coordinating = coordinator.run(event_queue);
    tokio::pin!(coordinating, shutdown);
    tokio::select! {
        () = &mut coordinating => {}
        () = &mut shutdown => {
            let (answer, _) = oneshot::channel();
            let _ = events.send(Event::Control(crate::coordinator::Control::Stop(answer))).await;
            coordinating.await;
        }
    }

    stop.store(true, Ordering::Relaxed);
    drop(close);
    // Whoever still holds a connection open then has had its time.
    let _ = tokio::time::timeout(CLOSE_TIMEOUT, server).await;
    let _ = fs::remove_file(run_dir.address());
    receiving.await.map_err(|_| LearnerError::Panicked("receive"))??;
    if let Err(error) = space.remove() {
        tracing::warn!(%error, "something of the run is still in shared memory");
    }
    let result = training.await.map_err(|_| LearnerError::Panicked("train"))?;
    writing.await.map_err(|_| LearnerError::Panicked("write"))?;
    Ok(result?)
}

/// What every episode of this run must look like.
pub fn expected(run_dir: &RunDir, config: &Config) -> Expected {
    let task_set = config.environment.task_set;
    Expected {
        run_id: run_dir.run_id(),
        layout: PayloadLayout::new(task_set.dims()),
        tasks: task_set.tasks(Split::Training).into_iter().map(rit_env::Task::size).collect(),
    }
}

/// The newest checkpoint that can be used, if any was ever written.
fn load(
    run_dir: &RunDir,
    rit: &Rit,
    expected: &Expected,
    buffer_size: usize,
) -> Result<Option<Loaded>, LearnerError> {
    let loaded = checkpoint::load_newest(run_dir, rit, expected, buffer_size)?;
    if let Some(Loaded { folder, state, damaged, .. }) = &loaded {
        for error in damaged {
            tracing::error!(%error, "a checkpoint is damaged; the one before is used");
        }
        let (folder, env_steps) = (folder.display(), state.manifest.progress.env_steps);
        tracing::info!(%folder, env_steps, "going on from a checkpoint");
    }
    Ok(loaded)
}

/// A named thread, and the way to its result.
fn spawn<T: Send + 'static>(
    name: &'static str,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<oneshot::Receiver<T>, LearnerError> {
    let (done, result) = oneshot::channel();
    let started = thread::Builder::new().name(name.to_owned()).spawn(move || {
        let _ = done.send(work());
    });
    started.map_err(|error| LearnerError::Io { what: format!("the {name} thread"), error })?;
    Ok(result)
}

/// Tells whoever reads the run directory where the learner listens: renamed into place, so it is whole.
fn write_address(run_dir: &RunDir, incoming: &Incoming) -> Result<(), LearnerError> {
    let path = run_dir.address();
    let partial: PathBuf = path.with_extension("partial");
    let written = incoming.address().and_then(|address| {
        fs::write(&partial, format!("{address}\n"))?;
        fs::rename(&partial, &path)
    });
    written.map_err(|error| LearnerError::Io { what: path.display().to_string(), error })
}
