//! Reads frames, checks them, and passes episodes on: [`receive`] is the thread that does so with those in shared
//! memory, where they lie.

use crate::{
    LearnerError,
    coordinator::{Event, Input},
    ledger::ActorId,
};
use rit_episode::wire::{self, Expected, Header, Rejection};
use rit_ipc::{EpisodeReceiver, ReceiveError};
use std::{
    mem,
    sync::{
        atomic::{AtomicBool, Ordering},
        mpsc,
    },
    time::{Duration, Instant},
};
use tokio::sync::mpsc as async_mpsc;

/// How long a wait for frames lasts before fences and the end of the run are looked at.
const WAIT: Duration = Duration::from_millis(50);

/// How often the places of dead actors are looked for.
const REAP_EVERY: Duration = Duration::from_secs(1);

/// Asks to be told, by [`Input::Fenced`], when all that was sent before has been passed on.
#[derive(Clone, Copy, Debug)]
pub struct Fence {
    /// Whose frames.
    pub actor: ActorId,
    /// Of which lease.
    pub lease: u64,
}

/// What a frame means, however it came.
pub fn read(header: Result<Header, Rejection>, payload: &[u8], expected: &Expected) -> Input {
    let read = header.and_then(|header| Ok((header.actor, wire::decode(&header, payload, expected)?)));
    match read {
        Ok((actor, episode)) => Input::Episode(actor, Box::new(episode)),
        Err(rejection) => {
            tracing::warn!(%rejection, "refused a frame");
            Input::FrameRefused(rejection.reason())
        }
    }
}

/// Receives until `stop` is set or its events have no receiver any more. A place that has been taken away is replaced by
/// that of the receiver that `renew` makes; [`Input::PlaceLost`] lets actors join again, there.
///
/// # Errors
/// When shared memory fails.
pub fn receive(
    mut receiver: EpisodeReceiver,
    renew: impl Fn() -> Result<(EpisodeReceiver, Option<String>), LearnerError>,
    expected: &Expected,
    events: &async_mpsc::Sender<Event>,
    fences: &mpsc::Receiver<Fence>,
    stop: &AtomicBool,
) -> Result<(), LearnerError> {
    let mut fences = Fences { queue: fences, taken: Vec::new() };
    loop {
        match receive_while_whole(&mut receiver, expected, events, &mut fences, stop) {
            Ok(End::Over) => return Ok(()),
            Ok(End::PlaceLost) => {}
            // Without its place anything may fail.
            Err(_) if !receiver.is_whole() => {}
            Err(error) => return Err(error.into()),
        }
        drop(receiver);
        let notice;
        (receiver, notice) = renew()?;
        tracing::warn!("the folder of the run's shared memory was removed and is made anew");
        if events.blocking_send(Input::PlaceLost(notice).into()).is_err() {
            return Ok(());
        }
    }
}

/// Why receiving ends.
enum End {
    /// No more is wanted.
    Over,
    /// The place is not there any more.
    PlaceLost,
}

/// The fences that are not answered yet. They outlive a place for shared memory: some are for actors on other hosts, whose
/// sessions go on.
struct Fences<'a> {
    queue: &'a mpsc::Receiver<Fence>,
    /// Taken up, and not answered.
    taken: Vec<Fence>,
}

impl Fences<'_> {
    /// Reads all frames that are there by `read_all`; returns what that says, and the fences that were taken up before it,
    /// which can be answered now. If it fails, they wait for the next time.
    fn after<T, E>(&mut self, read_all: impl FnOnce() -> Result<T, E>) -> Result<(T, Vec<Fence>), E> {
        self.taken.extend(self.queue.try_iter());
        let read = read_all()?;
        Ok((read, mem::take(&mut self.taken)))
    }
}

fn receive_while_whole(
    receiver: &mut EpisodeReceiver,
    expected: &Expected,
    events: &async_mpsc::Sender<Event>,
    fences: &mut Fences<'_>,
    stop: &AtomicBool,
) -> Result<End, ReceiveError> {
    let mut reaped = Instant::now();
    while !stop.load(Ordering::Relaxed) {
        let (wanted, passed) = fences.after(|| pass_on(receiver, expected, events))?;
        let tell = |fence| events.blocking_send(Input::Fenced(fence).into()).is_ok();
        if !wanted || !passed.into_iter().all(tell) {
            return Ok(End::Over);
        }
        if reaped.elapsed() >= REAP_EVERY {
            if !receiver.is_whole() {
                return Ok(End::PlaceLost);
            }
            receiver.reap_dead()?;
            reaped = Instant::now();
        }
        receiver.wait(WAIT)?;
    }
    Ok(End::Over)
}

/// Passes all frames on that are there; `false` when no more are wanted.
fn pass_on(
    receiver: &mut EpisodeReceiver,
    expected: &Expected,
    events: &async_mpsc::Sender<Event>,
) -> Result<bool, ReceiveError> {
    while let Some(frame) = receiver.receive()? {
        let input = read(Ok(*frame.header()), frame.payload(), expected);
        drop(frame);
        if events.blocking_send(input.into()).is_err() {
            return Ok(false);
        }
    }
    Ok(true)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fence_outlives_the_place_that_is_lost_while_frames_are_read() {
        let (sender, queue) = mpsc::channel();
        let mut fences = Fences { queue: &queue, taken: Vec::new() };
        let leases = |(_, passed): ((), Vec<Fence>)| -> Vec<u64> {
            passed.into_iter().map(|fence| fence.lease).collect()
        };
        sender.send(Fence { actor: 1, lease: 7 }).unwrap();
        let lost = fences.after(|| Err::<(), _>("the place is gone")).map(leases);
        assert_eq!(lost, Err("the place is gone"));
        // Asked for while frames are read: answered the next time.
        let while_read = || {
            sender.send(Fence { actor: 2, lease: 8 }).map_err(|_| "no receiver")?;
            Ok::<_, &str>(())
        };
        assert_eq!(fences.after(while_read).map(leases), Ok(vec![7]));
        assert_eq!(fences.after(|| Ok::<_, &str>(())).map(leases), Ok(vec![8]));
        assert_eq!(fences.after(|| Ok::<_, &str>(())).map(leases), Ok(vec![]));
    }
}
