//! What both ends share of iceoryx2: the node a process is known by, the service, and the removal of the dead.

use crate::{RunSpace, shared_memory};
use iceoryx2::config::Config;
use iceoryx2::node::{DeadNodeView, NodeView as _};
use iceoryx2::prelude::*;
use iceoryx2::service::builder::publish_subscribe::Builder;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use rit_episode::wire::{ALIGNMENT, Header};
use std::fmt::Debug;
use std::sync::Once;
use std::time::Duration;

/// The service as both ends have it.
pub(crate) type Episodes = PortFactory<Service, [Word], HeaderWords>;

/// Shared by threads, so that frames are `Send`.
pub(crate) type Service = ipc_threadsafe::Service;

/// A [`Header`] in a type that iceoryx2 knows to be plain.
pub(crate) type HeaderWords = [u64; size_of::<Header>() / size_of::<u64>()];
const _: () = assert!(size_of::<HeaderWords>() == size_of::<Header>());

/// What a payload is made of. Not bytes: iceoryx2 gives every *element* the alignment asked for, and a slice of
/// bytes aligned to 8 takes eight times its length.
pub(crate) type Word = [u8; ALIGNMENT];

/// The attribute of the service that holds the payload's length.
pub(crate) const PAYLOAD_LEN: &str = "payload_len";

const SERVICE: &str = "episodes";

/// How long to wait for another process that is removing the same dead node.
const REAP_PATIENCE: Duration = Duration::from_secs(1);

/// Something in iceoryx2 that has no better name here.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("shared memory: {doing} failed: {reason}; IOX2_LOG_LEVEL=debug says more")]
pub struct IceoryxError {
    doing: &'static str,
    reason: String,
}

impl IceoryxError {
    pub(crate) fn new(doing: &'static str, reason: impl Debug) -> Self {
        Self { doing, reason: in_words(&format!("{reason:?}")) }
    }
}

/// The name of an error of iceoryx2 as words: `InsufficientPermissions` is "insufficient permissions".
fn in_words(name: &str) -> String {
    let mut words = String::new();
    let mut before = ' ';
    for c in name.chars() {
        if c.is_ascii_uppercase() && before.is_ascii_lowercase() {
            words.push(' ');
        }
        before = c;
        words.push(c.to_ascii_lowercase());
    }
    words
}

/// Whose node it is: the reaper tells them apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Role {
    Learner,
    Actor,
}

impl Role {
    fn name(self) -> &'static str {
        match self {
            Self::Learner => "learner",
            Self::Actor => "actor",
        }
    }
}

pub(crate) fn create_node(space: &RunSpace, role: Role) -> Result<Node<Service>, IceoryxError> {
    static LOG_LEVEL: Once = Once::new();
    // Below that it tells of every dead process it meets.
    LOG_LEVEL.call_once(|| {
        // It answers a level that it does not know by printing, which ends a process whose output cannot be written.
        let known = ["trace", "debug", "info", "warn", "error", "fatal"];
        let level = std::env::var("IOX2_LOG_LEVEL").map(|level| level.to_lowercase());
        if level.is_ok_and(|level| known.contains(&level.as_str())) {
            set_log_level_from_env_or(LogLevel::Error);
        } else {
            set_log_level(LogLevel::Error);
        }
    });

    let name = NodeName::new(role.name()).map_err(|error| IceoryxError::new("naming a node", error))?;
    let node = NodeBuilder::new()
        .name(&name)
        .config(space.config())
        // Signals are tokio's.
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create()
        .map_err(|error| IceoryxError::new("creating a node", error))?;
    // The first node of a run makes a segment that all users may write to, under any umask.
    shared_memory::make_private(space.prefix())
        .map_err(|error| IceoryxError::new("keeping others out of shared memory", error))?;
    Ok(node)
}

/// The service, to be created by the learner and opened by actors.
pub(crate) fn service(node: &Node<Service>) -> Result<Builder<[Word], HeaderWords, Service>, IceoryxError> {
    let name = ServiceName::new(SERVICE).map_err(|error| IceoryxError::new("naming the service", error))?;
    let alignment =
        Alignment::new(ALIGNMENT).ok_or_else(|| IceoryxError::new("aligning the payload", ALIGNMENT))?;
    let service = node
        .service_builder(&name)
        .publish_subscribe::<[Word]>()
        .user_header::<HeaderWords>()
        .payload_alignment(alignment)
        .enable_safe_overflow(false)
        .history_size(0);
    Ok(service)
}

/// What a reaper has done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Reaped {
    /// Dead processes whose places are free now.
    pub removed: usize,
    /// Dead processes whose places could not be freed. Try again.
    pub left: usize,
}

/// Nodes of this run, and of this role if one is given, whose process is gone.
///
/// A dead node without details is left alone. It lost them while it was leaving or being reaped, after its places,
/// and iceoryx2 would look for what remains of it in the global root.
pub(crate) fn dead_nodes(
    config: &Config,
    role: Option<Role>,
) -> Result<Vec<DeadNodeView<Service>>, IceoryxError> {
    let mut dead = Vec::new();
    Node::<Service>::list(config, |state| {
        if let NodeState::Dead(node) = state
            && let Some(details) = node.details()
            && role.is_none_or(|role| details.name().as_str() == role.name())
        {
            dead.push(node);
        }
        CallbackProgression::Continue
    })
    .map_err(|error| IceoryxError::new("listing nodes", error))?;
    Ok(dead)
}

/// Frees everything dead nodes held.
pub(crate) fn remove(dead: Vec<DeadNodeView<Service>>) -> Reaped {
    let mut reaped = Reaped::default();
    for node in dead {
        let id = *node.id();
        match node.blocking_remove_stale_resources(REAP_PATIENCE) {
            Ok(()) => reaped.removed += 1,
            Err(error) => {
                tracing::warn!(%id, ?error, "a dead process could not be cleaned up yet");
                reaped.left += 1;
            }
        }
    }
    reaped
}
