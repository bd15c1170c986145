//! An actor process from its beginning to its end.

use crate::{
    losses::LostLeases,
    rollout::{Roller, RolloutError},
    sink::{EpisodeSink, FrameStream},
    weights::Weights,
};
use rit_algo::{ConfigError, Model};
use rit_config::{Config, RunDir, read_text, resolve};
use rit_env::FailureKind;
use rit_episode::wire::{self, PayloadLayout};
use rit_ipc::{EpisodeSender, OpenError, RunSpace, RunSpaceError};
use rit_proto::{
    transport::{self, Address, AddressError, Client, ConnectError, Credentials, status_words},
    v1::{
        ActorMessage, Heartbeat, Hello, LearnerMessage, Lease, Leaving, Welcome, actor_message,
        learner_message, rollout_client::RolloutClient,
    },
};
use std::{
    fmt, fs, io,
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::{Duration, Instant},
};
use tokio::sync::{mpsc, oneshot, watch};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Streaming};

/// How long an actor waits for the learner's shared memory.
const OPEN_TIMEOUT: Duration = Duration::from_secs(5);

/// From one sign of life to the next.
const HEARTBEAT_EVERY: Duration = Duration::from_secs(1);

/// Messages that may wait on their way to the learner.
const OUTBOX: usize = 16;

/// How long an actor waits for a learner that has gone to come back.
const RECONNECT_TIMEOUT: Duration = Duration::from_secs(60);

/// How long an actor whose environments fail waits for the learner to have read all it sent.
const FAREWELL_TIMEOUT: Duration = Duration::from_secs(5);

/// From one look for it to the next.
const RECONNECT_EVERY: Duration = Duration::from_millis(50);

/// Where an actor finds its learner.
#[derive(Clone, Debug)]
pub enum Learner {
    /// On this host, by its run directory: episodes travel through shared memory.
    Here(RunDir),
    /// On any host, by its address: episodes travel over gRPC.
    At(Address, Credentials),
}

/// What an actor is told on the command line.
#[derive(Clone, Debug)]
pub struct ActorOptions {
    /// Unique among the run's actors.
    pub name: String,
    /// The place that the supervisor of the learner's host fills with this actor, if one does.
    pub slot: Option<u32>,
    /// Whether a supervisor starts the learner, so that one that is away is waited for from the start.
    pub supervised: bool,
}

/// Why an actor ended early, or did not begin.
#[derive(Debug, thiserror::Error)]
pub enum ActorError {
    /// It is said nowhere where the learner is.
    #[error("no learner runs for {run_dir}: it has no address file ({error}); start `rit learner` first")]
    NoAddress {
        /// The run directory.
        run_dir: String,
        /// Why it cannot be read.
        error: io::Error,
    },
    /// What the address file says is no address.
    #[error(transparent)]
    Address(#[from] AddressError),
    /// No answer comes from there.
    #[error(transparent)]
    Connect(#[from] ConnectError),
    /// An actor of this name is there already, or the builds differ.
    #[error("the learner refused: {0}")]
    Refused(String),
    /// Another process of its slot has come.
    #[error("{0}")]
    Replaced(String),
    /// The learner's configuration means nothing here.
    #[error("the learner's configuration cannot be used: {0}; use the same build")]
    Config(#[from] rit_config::ConfigError),
    /// What the run's environments need is not on this host.
    #[error(transparent)]
    Worlds(#[from] rit_worlds::Unavailable),
    /// What the learner says of its run is not whole.
    #[error("the learner's run has no number of 16 bytes; use the same build")]
    RunId,
    /// The configuration makes no model.
    #[error(transparent)]
    Model(#[from] ConfigError),
    /// The run directory is no place for shared memory.
    #[error(transparent)]
    RunSpace(#[from] RunSpaceError),
    /// Shared memory cannot be had.
    #[error(transparent)]
    SharedMemory(#[from] OpenError),
    /// Rolling failed.
    #[error(transparent)]
    Rollout(#[from] RolloutError),
    /// The learner ended without a farewell.
    #[error("the learner has gone and does not come back: {0}")]
    LearnerGone(String),
    /// The system gives no random number.
    #[error("cannot draw a random number: {0}")]
    Random(io::Error),
    /// The rollout thread could not be started.
    #[error("cannot start the rollout thread: {0}")]
    Thread(io::Error),
    /// The rollout thread panicked.
    #[error("the rollout thread panicked; this is a fault of the program, its message is in the log")]
    Panicked,
}

impl ActorError {
    /// Whether another process would end the same way with this learner: what it sends is no weights of the model, or the
    /// environments do not work. A program that died may be there again, and its environments work then.
    pub fn is_permanent(&self) -> bool {
        match self {
            Self::Rollout(RolloutError::Weights(error)) => error.is_permanent(),
            Self::Rollout(RolloutError::Environment { lost, .. }) => lost.error.kind != FailureKind::Died,
            _ => false,
        }
    }

    /// Whether it may be different when the learner is back.
    fn may_pass(&self) -> bool {
        match self {
            Self::Connect(error) => error.may_pass(),
            Self::NoAddress { .. }
            | Self::Address(_)
            | Self::SharedMemory(_)
            | Self::LearnerGone(_)
            | Self::Rollout(RolloutError::Send(_)) => true,
            Self::Rollout(RolloutError::Weights(error)) => error.may_pass(),
            Self::Refused(_)
            | Self::Replaced(_)
            | Self::Config(_)
            | Self::Worlds(_)
            | Self::RunId
            | Self::Random(_)
            | Self::Model(_)
            | Self::RunSpace(_)
            | Self::Rollout(_)
            | Self::Thread(_)
            | Self::Panicked => false,
        }
    }
}

/// Runs an actor until the learner wants no more, or until `shutdown`: then it leaves in peace, which means
/// that all it has sent has been read. A learner that dies is waited for: the next one gets a fresh start.
///
/// # Errors
/// When it cannot begin, when rolling fails, or when the learner goes and does not come back.
pub async fn run(
    learner: Learner,
    options: ActorOptions,
    shutdown: impl Future<Output = ()>,
) -> Result<(), ActorError> {
    let mut instance = [0; size_of::<u64>()];
    // So few bytes come at once, or not at all.
    rustix::rand::getrandom(&mut instance, rustix::rand::GetRandomFlags::empty())
        .map_err(|error| ActorError::Random(error.into()))?;
    let actor = Actor { learner, options, instance: u64::from_le_bytes(instance) };
    let (leave, leaving) = watch::channel(false);
    let life = actor.life(leaving);
    tokio::pin!(life);
    tokio::select! {
        ended = &mut life => ended,
        () = shutdown => {
            leave.send_replace(true);
            life.await
        }
    }
}

impl Learner {
    /// Where it listens now, and what it wants to be shown.
    fn find(&self) -> Result<(Address, Credentials), ActorError> {
        match self {
            Self::At(address, credentials) => Ok((address.clone(), credentials.clone())),
            Self::Here(run_dir) => {
                let no_address =
                    |error| ActorError::NoAddress { run_dir: run_dir.root().display().to_string(), error };
                fs::metadata(run_dir.address()).map_err(no_address)?;
                // Not what the file says: in a copied directory it leads to the other's learner.
                Ok((Address::Unix(run_dir.socket()), Credentials::token(run_dir.token())))
            }
        }
    }
}

struct Actor {
    learner: Learner,
    options: ActorOptions,
    /// Tells this process from every other.
    instance: u64,
}

impl Actor {
    /// Session after session, until a farewell or until no learner comes back.
    async fn life(&self, mut leaving: watch::Receiver<bool>) -> Result<(), ActorError> {
        let mut gone_since = self.options.supervised.then(Instant::now);
        loop {
            let mut joined = false;
            let Err(error) = self.session(&mut leaving, &mut joined).await else { return Ok(()) };
            if joined {
                gone_since = Some(Instant::now());
            }
            // An actor that never met a learner and is not promised one says so at once.
            let Some(since) = gone_since.filter(|_| error.may_pass()) else { return Err(error) };
            if since.elapsed() >= RECONNECT_TIMEOUT {
                return Err(error);
            }
            if joined {
                tracing::warn!(%error, "waiting for the learner to come back");
            }
            tokio::select! {
                () = tokio::time::sleep(RECONNECT_EVERY) => {}
                // A learner that is gone waits for nothing of this actor.
                _ = leaving.wait_for(|leaving| *leaving) => return Ok(()),
            }
        }
    }

    /// One session with one learner, from Hello to Farewell. Sets `joined` once it is welcome.
    async fn session(
        &self,
        leaving: &mut watch::Receiver<bool>,
        joined: &mut bool,
    ) -> Result<(), ActorError> {
        let (address, credentials) = self.learner.find()?;
        let client = transport::connect(&address, &credentials).await?;
        let (outbox, from_learner, welcome) = self.join(client.clone()).await?;
        *joined = true;
        let actor = welcome.actor;
        let stop = Arc::new(AtomicBool::new(false));
        let roller = self.roller(client, welcome, Arc::clone(&stop)).await?;
        let (leases, lease_queue) = mpsc::channel(1);
        let (to_learner, from_roller) = mpsc::channel(1);
        let mut rolled = start(roller, lease_queue, to_learner)?;
        tracing::info!(actor, %address, "joined");

        let conversation = converse(from_learner, outbox, leases, from_roller, leaving);
        tokio::pin!(conversation);
        let ended = tokio::select! {
            ended = &mut conversation => ended,
            result = &mut rolled => {
                let error = result.map_err(|_| ActorError::Panicked)?.err();
                if let Some(RolloutError::Environment { .. }) = error {
                    // The thread has said what was lost, and that it leaves.
                    let _ = tokio::time::timeout(FAREWELL_TIMEOUT, conversation).await;
                }
                return Err(error.map_or(ActorError::Panicked, Into::into));
            }
        };
        // What is being rolled now is no longer wanted; the thread's place in shared memory must be free again.
        stop.store(true, Ordering::Relaxed);
        match rolled.await {
            Ok(Err(error @ RolloutError::Environment { .. })) => Err(error.into()),
            _ => ended,
        }
    }

    /// Says Hello, and waits for the answer.
    async fn join(&self, client: Client) -> Result<(Outbox, Streaming<LearnerMessage>, Welcome), ActorError> {
        let (outbox, messages) = mpsc::channel(OUTBOX);
        let hello = Hello {
            name: self.options.name.clone(),
            pid: std::process::id(),
            layout_version: wire::LAYOUT_VERSION,
            instance: self.instance,
            remote: matches!(self.learner, Learner::At(..)),
            slot: self.options.slot,
        };
        outbox.try_send(say(actor_message::Message::Hello(hello))).map_err(|error| gone(&error))?;
        let answer = RolloutClient::new(client).join(ReceiverStream::new(messages)).await;
        let mut from_learner = answer.map_err(|status| refusal(&status))?.into_inner();
        let welcome = from_learner.message().await.map_err(|status| refusal(&status))?;
        match welcome.and_then(|message| message.message) {
            Some(learner_message::Message::Welcome(welcome)) => Ok((outbox, from_learner, welcome)),
            _ => Err(gone(&"it did not say welcome")),
        }
    }

    /// What rolls the learner's episodes, until `stop` is set.
    async fn roller(
        &self,
        client: Client,
        welcome: Welcome,
        stop: Arc<AtomicBool>,
    ) -> Result<Roller, ActorError> {
        let Welcome { actor, run_id, config } = welcome;
        let config: Config = resolve(&config, "the learner's configuration", &[])?;
        rit_worlds::check(&config)?;
        let layout = PayloadLayout::new(config.dims());
        let model = Arc::new(Model::new(config.model())?);
        let acting_bytes = size_of::<f32>() * model.acting().len();
        Ok(Roller {
            model,
            rollout: Roller::rollout(&config),
            sink: self.sink(&client, &layout).await?,
            layout,
            run_id: run_id.try_into().map_err(|_| ActorError::RunId)?,
            actor,
            lost_leases: LostLeases::new(config.environment.lost_rounds_max),
            weights: Weights::new(client, acting_bytes),
            stop,
        })
    }

    /// Where its episodes go.
    async fn sink(&self, client: &Client, layout: &PayloadLayout) -> Result<EpisodeSink, ActorError> {
        match &self.learner {
            Learner::Here(run_dir) => {
                let path = run_dir.shared_memory();
                let place = read_text(&path).map_err(|error| gone(&error))?;
                let space = RunSpace::new(Path::new(place.trim_end()))?;
                let sender = EpisodeSender::open(&space, layout.len(), OPEN_TIMEOUT)?;
                Ok(EpisodeSink::SharedMemory(Box::new(sender)))
            }
            Learner::At(..) => {
                let stream = FrameStream::open(client.clone()).await;
                Ok(EpisodeSink::Stream(stream.map_err(|status| refusal(&status))?))
            }
        }
    }
}

/// Messages on their way to the learner.
type Outbox = mpsc::Sender<ActorMessage>;

/// Starts the rollout thread; returns the way to its result.
fn start(
    roller: Roller,
    leases: mpsc::Receiver<Lease>,
    to_learner: mpsc::Sender<actor_message::Message>,
) -> Result<oneshot::Receiver<Result<(), RolloutError>>, ActorError> {
    let (result, rolled) = oneshot::channel();
    let runtime = tokio::runtime::Handle::current();
    let started = thread::Builder::new().name("rollout".into()).spawn(move || {
        // The session may have ended.
        let _ = result.send(roller.run(&runtime, leases, &to_learner));
    });
    started.map_err(ActorError::Thread)?;
    Ok(rolled)
}

/// Passes leases on and says what the rollout thread has to say, until farewell.
async fn converse(
    mut from_learner: Streaming<LearnerMessage>,
    outbox: Outbox,
    leases: mpsc::Sender<Lease>,
    mut from_roller: mpsc::Receiver<actor_message::Message>,
    leaving: &mut watch::Receiver<bool>,
) -> Result<(), ActorError> {
    let mut heartbeat = tokio::time::interval(HEARTBEAT_EVERY);
    let mut said = false;
    loop {
        let message = tokio::select! {
            message = from_learner.message() => match message.map(|message| message.and_then(|m| m.message)) {
                Ok(Some(learner_message::Message::Lease(lease))) => {
                    // One lease at a time, so there is room; a thread that has ended is found by the caller.
                    let _ = leases.send(lease).await;
                    continue;
                }
                Ok(Some(learner_message::Message::Farewell(_))) => return Ok(()),
                Ok(Some(learner_message::Message::Welcome(_))) => continue,
                Ok(None) => return Err(gone(&"its stream ended without a farewell")),
                Err(status) if status.code() == Code::AlreadyExists => {
                    return Err(ActorError::Replaced(status.message().to_owned()));
                }
                Err(status) => return Err(gone(&status.message())),
            },
            Some(message) = from_roller.recv() => message,
            _ = leaving.wait_for(|leaving| *leaving), if !said => {
                said = true;
                actor_message::Message::Leaving(Leaving {})
            }
            _ = heartbeat.tick() => actor_message::Message::Heartbeat(Heartbeat { cpu_ms: cpu_ms() }),
        };
        if outbox.send(say(message)).await.is_err() {
            return Err(gone(&"it does not listen any more"));
        }
    }
}

/// Milliseconds of processor time that this process has taken.
pub(crate) fn cpu_ms() -> u64 {
    (1000.0 * rit_record::cpu_seconds()) as u64
}

fn say(message: actor_message::Message) -> ActorMessage {
    ActorMessage { message: Some(message) }
}

fn gone(what: &dyn fmt::Display) -> ActorError {
    ActorError::LearnerGone(what.to_string())
}

fn refusal(status: &tonic::Status) -> ActorError {
    match status.code() {
        // The last two: it has as much to do as it takes on.
        Code::Unavailable
        | Code::Cancelled
        | Code::Unknown
        | Code::ResourceExhausted
        | Code::DeadlineExceeded => ActorError::LearnerGone(status_words(status)),
        _ => ActorError::Refused(status_words(status)),
    }
}
