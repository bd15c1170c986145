//! An actor process from its beginning to its end.

use crate::{
    rollout::{Roller, RolloutError},
    weights::Weights,
};
use rit_algo::{ConfigError, Rit};
use rit_config::{Config, RunDir};
use rit_episode::wire::{self, PayloadLayout};
use rit_ipc::{EpisodeSender, OpenError, RunSpaceError};
use rit_proto::{
    transport::{self, Address, AddressError, ConnectError},
    v1::{
        ActorMessage, Done, Heartbeat, Hello, Leaving, actor_message, learner_message,
        rollout_client::RolloutClient,
    },
};
use std::{
    fs, io,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};
use tokio::sync::{mpsc, oneshot};
use tokio_stream::wrappers::ReceiverStream;
use tonic::Code;

/// How long an actor waits for the learner's shared memory.
const OPEN_TIMEOUT: Duration = Duration::from_secs(5);

/// From one sign of life to the next.
const HEARTBEAT_EVERY: Duration = Duration::from_secs(1);

/// Messages that may wait on their way to the learner.
const OUTBOX: usize = 16;

/// What an actor is told on the command line.
#[derive(Clone, Debug)]
pub struct ActorOptions {
    /// Unique among the run's actors.
    pub name: String,
}

/// Why an actor ended early, or did not begin.
#[derive(Debug, thiserror::Error)]
pub enum ActorError {
    /// Nobody says where the learner is.
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
    /// Nobody answers there.
    #[error(transparent)]
    Connect(#[from] ConnectError),
    /// An actor of this name is there already, or the builds differ.
    #[error("the learner refused: {0}")]
    Refused(String),
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
    #[error("the learner has gone: {0}")]
    LearnerGone(String),
    /// The rollout thread could not be started.
    #[error("cannot start the rollout thread: {0}")]
    Thread(io::Error),
    /// The rollout thread ended without a word.
    #[error("the rollout thread panicked; this is a fault of the program, its message is in the log")]
    Panicked,
}

/// Runs an actor until the learner wants no more, or until `shutdown`: then it leaves in peace, which means
/// that all it has sent has been read.
///
/// # Errors
/// When it cannot begin, when rolling fails, or when the learner goes without a farewell.
pub async fn run(
    run_dir: RunDir,
    config: Config,
    options: ActorOptions,
    shutdown: impl Future<Output = ()>,
) -> Result<(), ActorError> {
    let no_address = |error| ActorError::NoAddress { run_dir: run_dir.root().display().to_string(), error };
    let address: Address = fs::read_to_string(run_dir.address()).map_err(no_address)?.trim().parse()?;
    let client = transport::connect(&address, run_dir.token()).await?;

    let (outbox, messages) = mpsc::channel(OUTBOX);
    let say = |message| ActorMessage { message: Some(message) };
    let hello = Hello {
        name: options.name,
        pid: std::process::id(),
        layout_version: wire::LAYOUT_VERSION,
        capacity: config.actors.episodes_at_once as u32,
    };
    let gone = |what: &dyn std::fmt::Display| ActorError::LearnerGone(what.to_string());
    let first = outbox.try_send(say(actor_message::Message::Hello(hello)));
    first.map_err(|error| gone(&error))?;
    let joined = RolloutClient::new(client.clone()).join(ReceiverStream::new(messages)).await;
    let mut from_learner = joined.map_err(|status| refusal(&status))?.into_inner();
    let welcome = from_learner.message().await.map_err(|status| refusal(&status))?;
    let Some(learner_message::Message::Welcome(welcome)) = welcome.and_then(|message| message.message) else {
        return Err(gone(&"it did not say welcome"));
    };

    let (leases, lease_queue) = mpsc::channel(1);
    let (done, mut lease_done) = mpsc::channel(1);
    let stop = Arc::new(AtomicBool::new(false));
    let layout = PayloadLayout::new(config.environment.task_set.dims());
    let roller = Roller {
        rit: Arc::new(Rit::new(config.rit())?),
        rollout: Roller::rollout(&config),
        sender: EpisodeSender::open(&Roller::space(&run_dir)?, layout.len(), OPEN_TIMEOUT)?,
        layout,
        run_id: run_dir.run_id(),
        actor: welcome.actor,
        weights: Weights::watch(client).await.map_err(RolloutError::Weights)?,
        stop: Arc::clone(&stop),
    };
    let (result, mut rolled) = oneshot::channel();
    let runtime = tokio::runtime::Handle::current();
    thread::Builder::new()
        .name("rollout".into())
        .spawn(move || {
            let _ = result.send(roller.run(&runtime, lease_queue, &done));
        })
        .map_err(ActorError::Thread)?;
    tracing::info!(actor = welcome.actor, %address, "joined");

    let mut heartbeat = tokio::time::interval(HEARTBEAT_EVERY);
    let mut leaving = false;
    tokio::pin!(shutdown);
    let ended = loop {
        let message = tokio::select! {
            message = from_learner.message() => match message.map(|message| message.and_then(|m| m.message)) {
                Ok(Some(learner_message::Message::Lease(lease))) => {
                    // One lease at a time, so there is room; a thread that has ended is found below.
                    let _ = leases.send(lease).await;
                    continue;
                }
                Ok(Some(learner_message::Message::Farewell(_))) => break Ok(()),
                Ok(Some(learner_message::Message::Welcome(_))) => continue,
                Ok(None) => break Err(gone(&"its stream ended without a farewell")),
                Err(status) => break Err(gone(&status.message())),
            },
            Some(lease) = lease_done.recv() => actor_message::Message::Done(Done { lease }),
            result = &mut rolled => {
                return Err(result.map_err(|_| ActorError::Panicked)?.err().map_or(ActorError::Panicked, Into::into));
            }
            () = &mut shutdown, if !leaving => {
                leaving = true;
                actor_message::Message::Leaving(Leaving {})
            }
            _ = heartbeat.tick() => actor_message::Message::Heartbeat(Heartbeat {}),
        };
        if outbox.send(say(message)).await.is_err() {
            break Err(gone(&"it does not listen any more"));
        }
    };
    // What is being rolled now is nobody's any more.
    stop.store(true, Ordering::Relaxed);
    drop(leases);
    ended
}

fn refusal(status: &tonic::Status) -> ActorError {
    match status.code() {
        Code::Unavailable | Code::Cancelled | Code::Unknown => {
            ActorError::LearnerGone(status.message().to_owned())
        }
        _ => ActorError::Refused(status.message().to_owned()),
    }
}
