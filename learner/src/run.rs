//! A learner process from its beginning to its end.

use crate::{
    checkpoint::{self, CheckpointError, Loaded},
    control_service::ControlService,
    coordinator::{Control, Coordinator, Event, Shell},
    cpu_time::CpuTime,
    episodes_service::EpisodesService,
    initial::{InitialError, initial_params},
    life::{self, EndOfLife, LifeError},
    receive::receive,
    replay_log::{ReplayLog, ReplayLogError},
    rollout_service::RolloutService,
    run_handle::{RunHandle, SetLog},
    summary,
    trainer::{Made, TrainError, Trainer},
    web::{Web, WebError},
    weights::WeightsService,
    write_queue::write_queue,
    writer::Writer,
};
use rit_algo::{ConfigError, Learner, Model};
use rit_config::{Config, RunDir, Tls, write_whole};
use rit_env::Split;
use rit_episode::wire::{Expected, PayloadLayout};
use rit_ipc::{CreateError, EpisodeReceiver, Limits, ReceiveError};
use rit_policy::TaskNames;
use rit_proto::{
    transport::{
        Access, AccessError, AccessFiles, Address, AddressError, Incoming, ListenError, REQUEST_BYTES_MAX,
        ServeLimits, serve,
    },
    v1::{
        Welcome, control_server::ControlServer, episodes_server::EpisodesServer,
        rollout_server::RolloutServer, weights_server::WeightsServer,
    },
};
use rit_record::{Build, Ended, Summary};
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
use tokio::{
    sync::{mpsc as async_mpsc, oneshot, watch},
    task::JoinSet,
};
use tonic::service::Routes;

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
    /// A thread ended without a word.
    #[error("the {0} thread panicked; this is a fault of the program, its message is in the log")]
    Panicked(&'static str),
}

/// Runs a learner until T_max, until it is told to stop, or until `shutdown`, which means the same. `build` is this program,
/// for the run's record; `set_log` changes what it logs.
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
    let doors = listen(&run_dir, &config).await?;
    let web = Web::bind(&run_dir, config.web.listen).await?;
    let model = Arc::new(Model::new(config.model())?);
    let params = initial_params(&run_dir, &config, &model)?;
    let learner = rit_algo::learner(Arc::clone(&model), config.update(), params).map_err(|error| {
        LearnerError::Io { what: "the update's threads".into(), error: io::Error::other(error) }
    })?;
    let expected = expected(&run_dir, &config);
    let _end_of_life = EndOfLife(&run_dir);
    let limits = Limits::new(expected.layout.len(), config.actors.count.max(config.actors.count_max));
    let (receiver, notice) = new_receiver(&run_dir, limits)?;

    let (events, event_queue) = async_mpsc::channel(EVENT_QUEUE);
    let (work, work_queue) = mpsc::channel();
    let (fences, fence_queue) = mpsc::channel();
    let news = events.clone();
    let news = Box::new(move |what| {
        let _ = news.blocking_send(Event::News(what));
    });
    let measures = learner.measures();
    let logged = Expected { run_id: run_dir.lineage(), ..expected.clone() };
    let loaded = load(&run_dir, &*learner, &logged, &config)?;
    let episodes = loaded.as_ref().map_or(0, |loaded| loaded.state.manifest.progress.episodes);
    let writer = Writer {
        run_dir: run_dir.clone(),
        model: Arc::clone(&model),
        names: TaskNames::of(&config),
        log: ReplayLog::open(&run_dir.replay(), expected.layout, run_dir.lineage(), episodes)?,
        replay_episodes: config.replay_episodes(),
        keep: config.checkpoints.keep,
        events: events.clone(),
    };
    let (to_write, write_queue) = write_queue(config.replay_episodes());
    let cpu = Arc::new(CpuTime::default());
    let made = Made { build, cpu: Arc::clone(&cpu) };
    let (trainer, board) =
        Trainer::new(config.clone(), run_dir.clone(), learner, loaded, news, to_write, made)?;
    let metrics = trainer.metrics_follower();
    let welcome = Welcome { actor: 0, run_id: run_dir.run_id().to_vec(), config: config.to_toml()? };
    let mut beginning = trainer.beginning();
    beginning.warnings.extend(notice);
    let coordinator = Coordinator::new(config.clone(), beginning);
    let coordinator = Shell::new(coordinator, welcome, work, fences);
    pause_again(&run_dir, &events).await;

    let stop = Arc::new(AtomicBool::new(false));
    let expected = Arc::new(expected);
    let episodes = EpisodesService { events: events.clone(), expected: Arc::clone(&expected) };
    let receiving = {
        let (stop, run_dir) = (Arc::clone(&stop), run_dir.clone());
        let to_coordinator = events.clone();
        spawn_until_over("receive", &events, move || {
            let renew = || new_receiver(&run_dir, limits);
            receive(receiver, renew, &expected, &to_coordinator, &fence_queue, &stop)
        })?
    };
    let writing = spawn("write", move || writer.run(&write_queue))?;
    let training = spawn_until_over("train", &events, move || trainer.run(&work_queue))?;

    let handle =
        RunHandle::new(events.clone(), board.clone(), config, run_dir.clone(), model, measures, set_log);
    let mut serving_web = JoinSet::new();
    if let Some(web) = web {
        tracing::info!(address = %web.address(), "the web page is served");
        serving_web.spawn(web.serve(handle.clone(), metrics.clone(), run_dir.clone()));
    }
    let services = Services {
        weights: WeightsService(board),
        rollout: RolloutService { events: events.clone(), cpu },
        episodes,
        control: ControlService { run: handle, metrics },
    };
    let routes = services.routes().await;
    // From here on it goes on: what was said of its end is true no more.
    Summary::remove(&run_dir)
        .map_err(|error| LearnerError::Io { what: run_dir.summary().display().to_string(), error })?;
    let (close, closed) = watch::channel(());
    let servers = serve_all(&run_dir, doors, &routes, &closed)?;

    coordinate(coordinator.run(event_queue), &events, shutdown).await;

    stop.store(true, Ordering::Relaxed);
    drop(close);
    close_connections(servers, serving_web).await;
    for file in [run_dir.address(), run_dir.remote_address(), run_dir.paused()] {
        let _ = fs::remove_file(file);
    }
    let received = receiving.await.map_err(|_| LearnerError::Panicked("receive")).flatten();
    let trained = training.await.map_err(|_| LearnerError::Panicked("train"));
    writing.await.map_err(|_| LearnerError::Panicked("write"))?;
    let ended = received.and_then(|()| Ok(trained??));
    if let Err(error) = &ended
        && let Err(error) = summary::write_failed(&run_dir, &error.to_string())
    {
        tracing::error!(%error, "summary.json was not written");
    }
    ended
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

/// Serves at every door until `closed` changes, and tells readers of the run directory where.
fn serve_all(
    run_dir: &RunDir,
    doors: Vec<(Incoming, Access)>,
    routes: &Routes,
    closed: &watch::Receiver<()>,
) -> Result<JoinSet<Result<(), tonic::transport::Error>>, LearnerError> {
    // What a learner that was killed has left; this one may not listen for other hosts.
    let _ = fs::remove_file(run_dir.remote_address());
    let mut servers = JoinSet::new();
    for (incoming, access) in doors {
        tell_address(run_dir, incoming.address())?;
        tracing::info!(address = %incoming.address(), ?access, "the learner listens");
        let mut closed = closed.clone();
        let closed = async move {
            // Never a value: it changes by its end.
            let _ = closed.changed().await;
        };
        servers.spawn(serve(incoming, access, ServeLimits::default(), routes.clone(), closed));
    }
    Ok(servers)
}

/// Pauses a run whose learner was killed while it was paused: the first event, so no episode is handed out before it.
async fn pause_again(run_dir: &RunDir, events: &async_mpsc::Sender<Event>) {
    if run_dir.paused().is_file() {
        let (answer, _) = oneshot::channel();
        let _ = events.send(Event::Control(Control::Pause(answer))).await;
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
            let (answer, _) = oneshot::channel();
            let interrupt = Control::Stop { drain: false, ended: Ended::Interrupted, answer };
            let _ = events.send(Event::Control(interrupt)).await;
            coordinating.await;
        }
    }
}

/// Waits for servers to close their connections. Those that are open even after [`CLOSE_TIMEOUT`] have had their time.
async fn close_connections(
    mut servers: JoinSet<Result<(), tonic::transport::Error>>,
    mut serving_web: JoinSet<()>,
) {
    let closing = async {
        while let Some(served) = servers.join_next().await {
            if let Ok(Err(error)) = served {
                tracing::error!(%error, "a gRPC server failed");
            }
        }
    };
    let _ = tokio::time::timeout(CLOSE_TIMEOUT, closing).await;
    let _ = tokio::time::timeout(CLOSE_TIMEOUT, serving_web.join_next()).await;
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

/// As [`spawn`], and tells the coordinator when the work has ended: a run goes on with all of its threads or not at all.
fn spawn_until_over<T: Send + 'static>(
    name: &'static str,
    events: &async_mpsc::Sender<Event>,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<oneshot::Receiver<T>, LearnerError> {
    let events = events.clone();
    spawn(name, move || {
        let result = work();
        let _ = events.blocking_send(Event::Over);
        result
    })
}

/// Where the learner listens and what callers must show: the run directory's socket, and TCP if it is asked for.
async fn listen(run_dir: &RunDir, config: &Config) -> Result<Vec<(Incoming, Access)>, LearnerError> {
    let socket = Incoming::bind(&Address::Unix(run_dir.socket())).await?;
    let mut doors = vec![(socket, Access::token(run_dir.token()))];
    if config.learner.listen != "unix" {
        let address: Address = config.learner.listen.parse()?;
        let file = |path: &String| (!path.is_empty()).then(|| PathBuf::from(path));
        let Tls { certificate, key, client_ca } = &config.learner.tls;
        let files = AccessFiles {
            token: file(&config.learner.token_file),
            certificate: file(certificate),
            key: file(key),
            client_ca: file(client_ca),
        };
        let access = Access::over_tcp(&address, &files)?;
        doors.push((Incoming::bind(&address).await?, access));
    }
    Ok(doors)
}

/// Tells readers of the run directory where the learner listens: renamed into place, so it is whole.
fn tell_address(run_dir: &RunDir, address: &Address) -> Result<(), LearnerError> {
    let path = match address {
        Address::Unix(_) => run_dir.address(),
        Address::Tcp { .. } => run_dir.remote_address(),
    };
    let written = write_whole(&path, format!("{address}\n").as_bytes());
    written.map_err(|error| LearnerError::Io { what: path.display().to_string(), error })
}
