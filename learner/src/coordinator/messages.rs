//! What the coordinator is told, and what it wants done. Plain data: no channel, clock or connection in it.

use super::losses::Loss;
use crate::{
    ledger::{ActorId, Terms},
    receive::Fence,
    trainer::News,
    writer::CheckpointEnded,
};
use rit_config::Config;
use rit_episode::Episode;
use rit_record::Ended;
use std::sync::Arc;

/// What happens.
#[derive(Debug)]
pub enum Input {
    /// An episode was read and found valid.
    Episode(ActorId, Box<Episode>),
    /// A frame was refused, for a reason of this name.
    FrameRefused(&'static str),
    /// An actor wants to join. It is admitted or refused at once.
    Join(Joining),
    /// An actor has sent all of this lease, but for what was lost.
    Done(ActorId, u64, Vec<Loss>),
    /// All that an actor had sent by `Done` has been read.
    Fenced(Fence),
    /// An actor is there.
    Heartbeat(ActorId),
    /// An actor wants to go.
    Leaving(ActorId),
    /// An actor's stream has ended.
    Gone(ActorId),
    /// Shared memory is elsewhere from now on, with what a person should know of the new place: actors that send there have
    /// to join again.
    PlaceLost(Option<String>),
    /// The trainer speaks.
    News(News),
    /// The writer is done with a checkpoint.
    CheckpointEnded(CheckpointEnded),
    /// No further lease.
    Pause,
    /// Leases again.
    Resume,
    /// The end of the run, with what is under way (`drain`) or without.
    Stop {
        /// Whether episodes under way are waited for.
        drain: bool,
        /// What the run then ends as.
        ended: Ended,
    },
    /// Other settings from now on.
    Set(Arc<Config>),
    /// Time has passed. Comes every [`LOOK_EVERY`](super::LOOK_EVERY).
    Look,
    /// The trainer or the receiving thread is done, well or not: nothing more can happen.
    Over,
}

/// Who wants to join.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Joining {
    /// Its name, for people: one that [`RolloutService`](crate::rollout_service::RolloutService) lets in.
    pub name: String,
    /// Its process.
    pub pid: u32,
    /// Version of the wire layout its episodes have.
    pub layout_version: u32,
    /// Tells the process from every other.
    pub instance: u64,
    /// On another host.
    pub remote: bool,
    /// The place that the supervisor of this host fills with it.
    pub slot: Option<u32>,
}

/// What is to be done. Effects are carried out in their order.
#[derive(Debug)]
pub enum Effect {
    /// Who wants to join is welcome, as this actor.
    Admit(ActorId),
    /// Who wants to join is refused.
    Refuse(Refusal),
    /// Hand a lease to an actor.
    Lease {
        /// To whom.
        actor: ActorId,
        /// Names the lease in [`Input::Done`].
        lease: u64,
        /// The episodes' numbers.
        episodes: Vec<u64>,
        /// What they are rolled with.
        terms: Terms,
    },
    /// Tell an actor that nothing more is expected of it.
    Farewell(ActorId),
    /// Tell an actor that another process has taken its place.
    Replaced(ActorId),
    /// An actor is not there any more: close its stream.
    Dismiss(ActorId),
    /// Train on the next batch in order of number.
    Train(Vec<Episode>),
    /// Train with other settings.
    Configure(Arc<Config>),
    /// Train no more.
    EndTraining(Ended),
    /// Say when all that was sent by now has been read.
    Fence(Fence),
    /// The actors have gone, or were waited for long enough.
    Close,
}

/// Why an actor may not join.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// Another build.
    #[error("actor {name} writes frame layout {theirs}, this learner reads {ours}; use the same build")]
    Layout {
        /// Its name.
        name: String,
        /// What it writes.
        theirs: u32,
        /// What this learner reads.
        ours: u32,
    },
    /// There are as many of them as may be.
    #[error(
        "actor {name} is on another host, and the learner takes {max} of those; set actors.remote higher"
    )]
    Remote {
        /// Its name.
        name: String,
        /// How many may be there.
        max: usize,
    },
    /// Another actor has the name.
    #[error("an actor named {name} is there already (process {pid}); choose another --name")]
    Taken {
        /// The name.
        name: String,
        /// Whose it is.
        pid: u32,
    },
    /// Too late.
    #[error("the run is over")]
    Over,
}
