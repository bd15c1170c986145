//! The learner's end.

use crate::bell::Bell;
use crate::node::{self, Episodes, HeaderWords, IceoryxError, PAYLOAD_LEN, Reaped, Role, Service, Word};
use crate::{DirectoryError, Limits, NoSpace, RunSpace, check_space, shared_memory};
use iceoryx2::node::Node;
use iceoryx2::port::subscriber::{Subscriber, SubscriberCreateError};
use iceoryx2::prelude::AttributeVerifier;
use iceoryx2::sample::Sample;
use iceoryx2::service::builder::publish_subscribe::{
    PublishSubscribeCreateError, PublishSubscribeOpenError,
    PublishSubscribeOpenOrCreateError as OpenOrCreateError,
};
use rit_episode::wire::{ALIGNMENT, Header};
use std::fmt::Debug;
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::time::Duration;

/// Processes other than actors that may open the service: the learner, and a dead one not yet reaped.
const OTHER_NODES: usize = 2;

/// Why the learner's end could not be made.
#[derive(Debug, thiserror::Error)]
pub enum CreateError {
    /// Payloads that cannot lie one after the other.
    #[error("payloads of {payload_len} bytes cannot be aligned: take the length of a PayloadLayout")]
    Unaligned {
        /// The length.
        payload_len: usize,
    },
    /// The run's directory.
    #[error(transparent)]
    Directory(#[from] DirectoryError),
    /// Too little shared memory for all senders.
    #[error(transparent)]
    NoSpace(#[from] NoSpace),
    /// No shared memory at all.
    #[error("{path} cannot be used for shared memory: {source}")]
    SharedMemory {
        /// What was asked for.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// One receiver per run.
    #[error("the run in {directory} has a learner already: stop it, or choose another directory")]
    AnotherLearner {
        /// The run's directory.
        directory: PathBuf,
    },
    /// A learner was killed while it cleaned up after another that had been killed: iceoryx2 cannot finish that.
    #[error(
        "the place of a killed learner in {directory} cannot be freed: stop the run's actors, then start the \
         learner again"
    )]
    StalePlace {
        /// The run's directory.
        directory: PathBuf,
    },
    /// Actors of the same run still live, with another learner's limits.
    #[error("actors in {directory} still run for a learner of {other}: stop them first")]
    OtherLimits {
        /// The run's directory.
        directory: PathBuf,
        /// What differs.
        other: &'static str,
    },
    /// Anything else.
    #[error(transparent)]
    Iceoryx(#[from] IceoryxError),
}

/// Why frames could not be received.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ReceiveError {
    /// iceoryx2 would not.
    #[error(transparent)]
    Iceoryx(#[from] IceoryxError),
}

/// The learner's end: one per run.
#[derive(Debug)]
pub struct EpisodeReceiver {
    // Dropped in this order.
    subscriber: Subscriber<Service, [Word], HeaderWords>,
    _service: Episodes,
    _node: Node<Service>,
    bell: Bell,
    space: RunSpace,
    _lock: OwnedFd,
}

impl EpisodeReceiver {
    /// Makes the run's place, or takes it over from a learner that has ended: senders that still live then send
    /// here. What they had delivered to the former learner is lost.
    ///
    /// # Errors
    /// When there is too little shared memory for all senders, another learner, or no usable directory.
    pub fn create(space: &RunSpace, limits: Limits) -> Result<Self, CreateError> {
        let payload_len = limits.payload_len;
        if !payload_len.is_multiple_of(ALIGNMENT) {
            return Err(CreateError::Unaligned { payload_len });
        }
        space.make_directory()?;
        let lock = space
            .lock()?
            .ok_or_else(|| CreateError::AnotherLearner { directory: space.directory().to_path_buf() })?;
        let node = node::create_node(space, Role::Learner)?;
        // A dead learner holds the only place for one. Dead actors delivered to a dead learner, if at all.
        node::remove(node::dead_nodes(space.config(), None)?);
        check_room(space, &limits)?;
        // Before the service, so that a sender that finds the service finds the bell.
        let bell_path = space.segment(crate::bell::NAME);
        let bell = Bell::create(&bell_path)
            .map_err(|error| CreateError::SharedMemory { path: bell_path, source: error.into() })?;

        let service = create_service(space, &node, &limits)?;
        let subscriber = service.subscriber_builder().create().map_err(|error| match error {
            // The lock says that no living process has it.
            SubscriberCreateError::ExceedsMaxSupportedSubscribers => {
                CreateError::StalePlace { directory: space.directory().to_path_buf() }
            }
            error => IceoryxError::new("creating the subscriber", error).into(),
        })?;
        Ok(Self { subscriber, _service: service, _node: node, bell, space: space.clone(), _lock: lock })
    }

    /// The next frame, if one has come: in order for each sender, from any of them. The sender's place for a frame
    /// is free again when the frame is dropped.
    ///
    /// While several senders deliver faster than frames are received, those who came first are served first; what
    /// keeps the others from starving is that no actor rolls more episodes than it was asked for.
    ///
    /// # Errors
    /// When iceoryx2 fails.
    pub fn receive(&mut self) -> Result<Option<ReceivedFrame>, ReceiveError> {
        let received = self.subscriber.receive();
        let sample = received.map_err(|error| IceoryxError::new("receiving a frame", error))?;
        Ok(sample.map(|sample| ReceivedFrame { sample }))
    }

    /// Sleeps until a frame has come or the time is over, and says whether one is there.
    ///
    /// May return early without one. Limit the time to how long a frame may lie there after its sender was killed
    /// between sending it and saying so: a second, say.
    ///
    /// # Errors
    /// When iceoryx2 fails.
    pub fn wait(&mut self, time_limit: Duration) -> Result<bool, ReceiveError> {
        self.bell.sleep_unless(time_limit, || self.has_frames())?;
        self.has_frames()
    }

    /// Frees the places of killed processes. What a killed actor has delivered can still be received.
    ///
    /// Call it when an actor has died, and every few seconds.
    ///
    /// # Errors
    /// When iceoryx2 fails.
    pub fn reap_dead(&mut self) -> Result<Reaped, ReceiveError> {
        let dead = node::dead_nodes(self.space.config(), None)?;
        if dead.is_empty() {
            return Ok(Reaped::default());
        }
        // Connects to every sender there is, the dead among them: what they have delivered is mapped now and
        // outlives the removal. The other way round it would be lost.
        self.has_frames()?;
        Ok(node::remove(dead))
    }

    /// Whether its place is still there. What cleans temporary folders may take it away: then no new process finds it, and a
    /// receiver in a fresh one is needed.
    pub fn is_whole(&self) -> bool {
        self.space.is_whole()
    }

    /// Looks for frames, and connects to senders that are new.
    fn has_frames(&self) -> Result<bool, ReceiveError> {
        let found = self.subscriber.has_samples();
        Ok(found.map_err(|error| IceoryxError::new("looking for frames", error))?)
    }
}

/// A frame where it lies in shared memory. A sender waits for its place: hold few, and not for long.
#[derive(Debug)]
pub struct ReceivedFrame {
    sample: Sample<Service, [Word], HeaderWords>,
}

impl ReceivedFrame {
    /// The fixed part. Not yet checked: see [`rit_episode::wire::decode`].
    pub fn header(&self) -> &Header {
        bytemuck::cast_ref(self.sample.user_header())
    }

    /// The padded part, aligned to [`rit_episode::wire::ALIGNMENT`].
    pub fn payload(&self) -> &[u8] {
        self.sample.payload().as_flattened()
    }
}

/// Frames may be handed to another thread.
const _: fn() = || {
    fn is_send<T: Send>() {}
    is_send::<ReceivedFrame>();
    is_send::<EpisodeReceiver>();
};

/// Whether all senders fit, those that are there already counted once.
fn check_room(space: &RunSpace, limits: &Limits) -> Result<(), CreateError> {
    let at = |source| CreateError::SharedMemory { path: shared_memory::DIRECTORY.into(), source };
    let taken = shared_memory::taken(space.prefix()).map_err(at)?;
    let free = shared_memory::free().map_err(|error| at(error.into()))?;
    Ok(check_space(limits.bytes().saturating_sub(taken), free)?)
}

/// Opens the service that actors still have of a former learner, or creates it.
fn create_service(space: &RunSpace, node: &Node<Service>, limits: &Limits) -> Result<Episodes, CreateError> {
    let created = match try_create_service(node, limits)? {
        // Left by a learner that was killed while it created the service. No process has opened it or ever will, and
        // while we hold the lock no process works on it.
        Err(error) if is_half_made(&error) => {
            space.remove_services()?;
            try_create_service(node, limits)?
        }
        created => created,
    };
    created.map_err(|error| service_error(space, error))
}

fn try_create_service(
    node: &Node<Service>,
    limits: &Limits,
) -> Result<Result<Episodes, OpenOrCreateError>, IceoryxError> {
    let failed = |error: &dyn Debug| IceoryxError::new("stating the payload's length", error);
    let key = PAYLOAD_LEN.try_into().map_err(|error| failed(&error))?;
    let value = limits.payload_len.to_string().as_str().try_into();
    let value = value.map_err(|error| failed(&error))?;
    let payload_len = AttributeVerifier::new().require(&key, &value);
    let payload_len = payload_len.map_err(|error| failed(&error))?;
    let frames = limits.frames();
    Ok(node::service(node)?
        .max_subscribers(1)
        .max_publishers(limits.max_senders)
        .max_nodes(limits.max_senders + OTHER_NODES)
        // As many as a sender has: its queue is never full, and however many frames the learner holds, that is no
        // error but a sender that waits.
        .subscriber_max_buffer_size(frames)
        .subscriber_max_borrowed_samples(frames)
        .open_or_create_with_attributes(&payload_len))
}

fn is_half_made(error: &OpenOrCreateError) -> bool {
    use PublishSubscribeCreateError as Create;
    use PublishSubscribeOpenError as Open;
    matches!(
        error,
        OpenOrCreateError::PublishSubscribeOpenError(Open::HangsInCreation | Open::ServiceInCorruptedState)
            | OpenOrCreateError::PublishSubscribeCreateError(
                Create::HangsInCreation | Create::ServiceInCorruptedState
            )
    )
}

fn service_error(space: &RunSpace, error: OpenOrCreateError) -> CreateError {
    use PublishSubscribeOpenError as Open;
    let other = match &error {
        OpenOrCreateError::PublishSubscribeOpenError(open) => match open {
            Open::IncompatibleAttributes => Some("another payload length"),
            Open::DoesNotSupportRequestedAmountOfPublishers | Open::DoesNotSupportRequestedAmountOfNodes => {
                Some("fewer senders")
            }
            Open::DoesNotSupportRequestedMinBufferSize
            | Open::DoesNotSupportRequestedMinSubscriberBorrowedSamples => Some("fewer frames per sender"),
            Open::IncompatibleTypes | Open::VersionMismatch => Some("another version"),
            _ => None,
        },
        _ => None,
    };
    match other {
        Some(other) => CreateError::OtherLimits { directory: space.directory().to_path_buf(), other },
        None => IceoryxError::new("creating the service", error).into(),
    }
}
