//! An actor's end.

use crate::backoff::Backoff;
use crate::bell::Bell;
use crate::node::{self, Episodes, HeaderWords, IceoryxError, PAYLOAD_LEN, Reaped, Role, Service, Word};
use crate::{DirectoryError, Limits, NoSpace, RunSpace, check_space, shared_memory};
use iceoryx2::node::Node;
use iceoryx2::port::LoanError;
use iceoryx2::port::publisher::{Publisher, PublisherCreateError};
use iceoryx2::port::update_connections::UpdateConnections as _;
use iceoryx2::prelude::{AllocationStrategy, BackpressureStrategy, PortFactory as _};
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError;
use rit_episode::wire::{ALIGNMENT, Frame};
use rustix::io::Errno;
use std::io::ErrorKind;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// How often a sender that waits looks whether it waits for a dead learner.
const REAP_EVERY: Duration = Duration::from_millis(500);

/// Why an actor's end could not be made.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The run's directory.
    #[error(transparent)]
    Directory(#[from] DirectoryError),
    /// There is no learner to send to.
    #[error("no learner in {directory} after {waited:.1?}: start it first, with the same run directory")]
    NoLearner {
        /// The run's directory.
        directory: PathBuf,
        /// How long it was looked for.
        waited: Duration,
    },
    /// As many senders as the learner allows.
    #[error(
        "all places for senders in {directory} are taken: have the learner reap its dead, or allow more senders"
    )]
    NoPlace {
        /// The run's directory.
        directory: PathBuf,
    },
    /// Learner and actor are configured for different dims.
    #[error(
        "the learner expects payloads of {learner} bytes, this actor's have {actor}: give both the same experiment"
    )]
    PayloadLen {
        /// Bytes the learner expects.
        learner: String,
        /// Bytes this actor would send.
        actor: usize,
    },
    /// Too little shared memory for this sender.
    #[error(transparent)]
    NoSpace(#[from] NoSpace),
    /// A segment that should be there is not.
    #[error("{path} in shared memory cannot be used: {source}")]
    SharedMemory {
        /// The segment.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// Anything else.
    #[error(transparent)]
    Iceoryx(#[from] IceoryxError),
}

/// Why a frame was not sent. It was not sent at all: no part of it arrives.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SendError {
    /// The caller's `give_up` said so.
    #[error("gave up sending a frame after {waited:.1?}: the learner is gone or too slow")]
    GaveUp {
        /// How long the learner was waited for.
        waited: Duration,
    },
    /// A frame of other dims than the sender was opened for.
    #[error("a frame of {found} bytes was given to a sender of {expected}")]
    PayloadLen {
        /// Bytes of the frame's payload.
        found: usize,
        /// Bytes of every payload of the run.
        expected: usize,
    },
    /// iceoryx2 would not.
    #[error(transparent)]
    Iceoryx(#[from] IceoryxError),
}

/// An actor's end: one of at most [`Limits::max_senders`].
///
/// # Leaving is a conversation
/// A frame that was sent lies in this process's memory until the learner has connected to it, which happens at the
/// learner's next [`receive`](crate::EpisodeReceiver::receive) or [`wait`](crate::EpisodeReceiver::wait). A sender
/// dropped before that takes its frames along, although `send` returned `Ok`. So before an actor ends, it tells the
/// learner its last episode's number, over another channel, and stays until the learner answers that it has it.
#[derive(Debug)]
pub struct EpisodeSender {
    // Dropped in this order.
    publisher: Publisher<Service, [Word], HeaderWords>,
    service: Episodes,
    _node: Node<Service>,
    bell: Bell,
    space: RunSpace,
    payload_len: usize,
}

impl EpisodeSender {
    /// Takes one of the run's places for senders, and all the shared memory it will ever use. Waits for a learner
    /// until the time is over.
    ///
    /// # Errors
    /// When there is no learner in time, no free place, too little shared memory, or a learner of other dims.
    pub fn open(space: &RunSpace, payload_len: usize, time_limit: Duration) -> Result<Self, OpenError> {
        let (node, service) = find_learner(space, time_limit)?;
        check_payload_len(&service, payload_len)?;
        let frames = service.static_config().subscriber_max_buffer_size();
        let limits = Limits { payload_len, max_senders: 1, frames_per_sender: frames };
        let at = |path: PathBuf| move |error: Errno| OpenError::SharedMemory { path, source: error.into() };
        let free = || shared_memory::free().map_err(at(shared_memory::DIRECTORY.into()));
        let needed = limits.bytes_per_sender();
        check_space(needed, free()?)?;

        let bell_path = space.segment(crate::bell::NAME);
        let bell = Bell::open(&bell_path).map_err(at(bell_path))?;
        let publisher = service
            .publisher_builder()
            .initial_max_slice_len(payload_len / ALIGNMENT)
            .allocation_strategy(AllocationStrategy::Static)
            .max_loaned_samples(1)
            // No more frames than the learner's queue holds. So the queue is never full when there is a frame to
            // send, and a learner that is too slow shows where it costs nothing: at the loan, before the copy.
            .override_sample_preallocation(move |_| frames)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(|error| match error {
                PublisherCreateError::ExceedsMaxSupportedPublishers => {
                    OpenError::NoPlace { directory: space.directory().to_path_buf() }
                }
                error => IceoryxError::new("creating the publisher", error).into(),
            })?;
        // Between the check above and here others may have taken the space: an error now, no SIGBUS later.
        let segment = format!("{}.data", publisher.id().value());
        match shared_memory::reserve(space.prefix(), &segment) {
            Err(Errno::NOSPC) => {
                let free = free()?.min(needed);
                return Err(NoSpace { needed, free }.into());
            }
            outcome => outcome.map_err(at(segment.into()))?,
        }
        // The learner connects now, rather than at the first frame.
        bell.ring();
        Ok(Self { publisher, service, _node: node, bell, space: space.clone(), payload_len })
    }

    /// Copies a frame into shared memory and hands it to the learner. Waits while there is no learner, and while
    /// the learner still has all of this sender's frames to read. `give_up` is asked at least every 5 ms of waiting,
    /// and not at all when there is nothing to wait for.
    ///
    /// `Ok` means that the frame is in a learner's queue. A learner that dies loses its queue, and a sender that
    /// leaves early takes it along (see above): whether an episode has arrived only the learner can say.
    ///
    /// # Errors
    /// When `give_up` said so, or the frame is of other dims.
    pub fn send(&mut self, frame: &Frame, give_up: &dyn Fn() -> bool) -> Result<(), SendError> {
        if frame.payload.len() != self.payload_len {
            return Err(SendError::PayloadLen { found: frame.payload.len(), expected: self.payload_len });
        }
        let mut backoff = None;
        let mut reaped = Duration::ZERO;
        while !self.try_send(frame)? {
            let backoff = backoff.get_or_insert_with(Backoff::new);
            let waited = backoff.waited();
            if give_up() {
                return Err(SendError::GaveUp { waited });
            }
            if waited - reaped >= REAP_EVERY {
                reaped = waited;
                self.reap_dead()?;
            }
            backoff.nap();
            // Takes back what a learner held that is no longer there.
            let updated = self.publisher.update_connections();
            updated.map_err(|error| IceoryxError::new("connecting to the learner", error))?;
        }
        Ok(())
    }

    /// Frees the place of a killed learner, so that nothing waits for it and another may come. Dead actors are the
    /// learner's to reap: it has to connect to them before.
    ///
    /// # Errors
    /// When iceoryx2 fails.
    pub fn reap_dead(&self) -> Result<Reaped, SendError> {
        let dead = node::dead_nodes(self.space.config(), Some(Role::Learner))?;
        Ok(node::remove(dead))
    }

    /// Sends a frame if a learner is there and has room.
    fn try_send(&self, frame: &Frame) -> Result<bool, SendError> {
        if self.service.dynamic_config().number_of_subscribers() == 0 {
            return Ok(false);
        }
        // Whole words: the learner's length is, and the frame's is the learner's.
        let (words, _) = frame.payload.as_chunks();
        let mut slot = match self.publisher.loan_slice_uninit(words.len()) {
            Ok(slot) => slot,
            Err(LoanError::OutOfMemory) => return Ok(false),
            Err(error) => return Err(IceoryxError::new("loaning shared memory", error).into()),
        };
        *slot.user_header_mut() = bytemuck::cast(frame.header);
        let sent = slot.write_from_slice(words).send();
        // 0: the learner has left in the meantime.
        let receivers = sent.map_err(|error| IceoryxError::new("sending a frame", error))?;
        if receivers > 0 {
            self.bell.ring();
        }
        Ok(receivers > 0)
    }
}

/// Waits until the run has a living learner.
fn find_learner(space: &RunSpace, time_limit: Duration) -> Result<(Node<Service>, Episodes), OpenError> {
    let began = Instant::now();
    let mut backoff = Backoff::new();
    let no_learner = |waited| OpenError::NoLearner { directory: space.directory().to_path_buf(), waited };
    // The directory is the learner's to make: an actor that outlives its run leaves nothing there.
    while let Err(error) = space.check_directory() {
        match error {
            DirectoryError::Io { source, .. } if source.kind() == ErrorKind::NotFound => {}
            error => return Err(error.into()),
        }
        if began.elapsed() >= time_limit {
            return Err(no_learner(began.elapsed()));
        }
        backoff.nap();
    }
    let node = node::create_node(space, Role::Actor)?;
    loop {
        if let Some(service) = try_find_learner(space, &node)? {
            return Ok((node, service));
        }
        if began.elapsed() >= time_limit {
            return Err(no_learner(began.elapsed()));
        }
        backoff.nap();
    }
}

fn try_find_learner(space: &RunSpace, node: &Node<Service>) -> Result<Option<Episodes>, OpenError> {
    use PublishSubscribeOpenError as Open;
    node::remove(node::dead_nodes(space.config(), Some(Role::Learner))?);
    match node::service(node)?.open() {
        Ok(service) if service.dynamic_config().number_of_subscribers() > 0 => Ok(Some(service)),
        // Being made, or being removed with the last who had it.
        Ok(_)
        | Err(
            Open::DoesNotExist
            | Open::IsMarkedForDestruction
            | Open::HangsInCreation
            | Open::ServiceInCorruptedState
            | Open::InsufficientPermissions,
        ) => Ok(None),
        Err(Open::ExceedsMaxNumberOfNodes) => {
            Err(OpenError::NoPlace { directory: space.directory().to_path_buf() })
        }
        Err(error) => Err(IceoryxError::new("opening the service", error).into()),
    }
}

fn check_payload_len(service: &Episodes, actor: usize) -> Result<(), OpenError> {
    let key = PAYLOAD_LEN.try_into();
    let key = key.map_err(|error| IceoryxError::new("reading the payload's length", error))?;
    let learner = service.attributes().key_value(&key, 0);
    let learner = learner.map(ToString::to_string).unwrap_or_default();
    if learner != actor.to_string() {
        return Err(OpenError::PayloadLen { learner, actor });
    }
    Ok(())
}
