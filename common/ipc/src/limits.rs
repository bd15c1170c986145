//! How much of everything a run may have.

use std::ops::RangeInclusive;

/// Frames one sender may have on the way, by default as many as take [`SENDER_BYTES`]: enough that the learner, while a
/// sender sleeps that was ahead, does not run dry and sleep too, and few enough to stay in a core's cache. With frames of
/// 64 KiB, 8, 16, 20, 24, 32 and 64 of them, a frame cost both sides together 17.4, 13.8, 13.0, 13.5, 13.7 and 14.7 µs
/// (8, 16 and 64 on other days, when 32 took 13.2). Frames that take longer to copy than a sender sleeps do with fewer.
const FRAMES_PER_SENDER: RangeInclusive<usize> = 8..=32;
const SENDER_BYTES: usize = 5 << 18;

/// Places beyond one for each actor: a restarted actor may come before its dead self is reaped.
const RESTART_ROOM: usize = 2;

/// Bytes of a frame beside its payload: our header, iceoryx2's, alignment and bookkeeping.
const FRAME_OVERHEAD: usize = 256;
/// Bytes of a sender beside its frames: its queue to the learner, and pages not filled.
const SENDER_OVERHEAD: usize = 16 << 10;
/// Bytes of a run beside its senders: the list of who takes part, the bell.
const RUN_OVERHEAD: usize = 64 << 10;

/// What the learner lays down for the whole run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Bytes of every payload: [`rit_episode::wire::PayloadLayout::len`], a multiple of its `ALIGNMENT`.
    pub payload_len: usize,
    /// Places for senders, those of dead actors not yet reaped included.
    pub max_senders: usize,
    /// Frames one sender may have on the way: written, in the queue, or held by the learner.
    pub frames_per_sender: usize,
}

impl Limits {
    /// Limits for so many actors, with room for restarted ones.
    pub fn new(payload_len: usize, actors: usize) -> Self {
        let (fewest, most) = FRAMES_PER_SENDER.into_inner();
        let frames_per_sender = (SENDER_BYTES / payload_len.max(1)).clamp(fewest, most);
        Self { payload_len, max_senders: actors + RESTART_ROOM, frames_per_sender }
    }

    /// Shared memory the run needs when every place is taken, in bytes. A little more than that, for iceoryx2's
    /// own needs.
    pub fn bytes(&self) -> u64 {
        (RUN_OVERHEAD as u64)
            .saturating_add((self.max_senders as u64).saturating_mul(self.bytes_per_sender()))
    }

    /// None would be no channel.
    pub(crate) fn frames(&self) -> usize {
        self.frames_per_sender.max(1)
    }

    pub(crate) fn bytes_per_sender(&self) -> u64 {
        let frame = (self.payload_len as u64).saturating_add(FRAME_OVERHEAD as u64);
        frame.saturating_mul(self.frames() as u64).saturating_add(SENDER_OVERHEAD as u64)
    }
}
