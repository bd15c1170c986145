//! Reads frames, checks them, and passes episodes on: [`receive`] is the thread that does so with those in shared
//! memory, where they lie.

use crate::{LearnerError, coordinator::Event, ledger::ActorId};
use rit_episode::wire::{self, Expected, Header, Rejection};
use rit_ipc::{EpisodeReceiver, ReceiveError};
use std::{
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

/// Asks to be told, by [`Event::Fenced`], when all that was sent before has been passed on.
#[derive(Clone, Copy, Debug)]
pub struct Fence {
    /// Whose frames.
    pub actor: ActorId,
    /// Of which lease.
    pub lease: u64,
}

/// What a frame means, however it came.
pub fn read(header: Result<Header, Rejection>, payload: &[u8], expected: &Expected) -> Event {
    let read = header.and_then(|header| Ok((header.actor, wire::decode(&header, payload, expected)?)));
    match read {
        Ok((actor, episode)) => Event::Episode(actor, Box::new(episode)),
        Err(rejection) => {
            tracing::warn!(%rejection, "refused a frame");
            Event::FrameRefused(rejection.reason())
        }
    }
}

/// Receives until `stop` is set or its events have no receiver any more. A place that has been taken away is replaced by that of
/// the receiver that `renew` makes; [`Event::PlaceLost`] lets actors join again, there.
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
    loop {
        match receive_while_whole(&mut receiver, expected, events, fences, stop) {
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
        if events.blocking_send(Event::PlaceLost(notice)).is_err() {
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

fn receive_while_whole(
    receiver: &mut EpisodeReceiver,
    expected: &Expected,
    events: &async_mpsc::Sender<Event>,
    fences: &mpsc::Receiver<Fence>,
    stop: &AtomicBool,
) -> Result<End, ReceiveError> {
    let mut reaped = Instant::now();
    while !stop.load(Ordering::Relaxed) {
        // Fences are taken up before frames are read and answered after.
        let fences: Vec<Fence> = fences.try_iter().collect();
        while let Some(frame) = receiver.receive()? {
            let event = read(Ok(*frame.header()), frame.payload(), expected);
            drop(frame);
            if events.blocking_send(event).is_err() {
                return Ok(End::Over);
            }
        }
        for fence in fences {
            if events.blocking_send(Event::Fenced(fence)).is_err() {
                return Ok(End::Over);
            }
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
