//! Places for connections. A caller that has not shown yet that it may speak is a *stranger*: it has one of a few places of
//! its own for a few seconds, and gives it up to the next stranger when all are taken. One that has shown it is *known*
//! and has one of the other places for as long as it stays. So no number of silent connections keeps a known caller out.

use std::{
    collections::VecDeque,
    io,
    pin::Pin,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    task::{Context, Poll},
    time::Duration,
};
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    sync::oneshot,
    time::Sleep,
};

/// How many connections a door has room for.
#[derive(Clone, Copy, Debug)]
pub struct PlaceLimits {
    /// Known ones.
    pub known: usize,
    /// Strangers.
    pub strangers: usize,
    /// How long one may stay a stranger.
    pub deadline: Duration,
}

/// The places of one door.
#[derive(Clone, Debug)]
pub struct Places(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    limits: PlaceLimits,
    known: AtomicUsize,
    /// The strangers, oldest first, each with the way to end it.
    strangers: Mutex<VecDeque<(u64, oneshot::Sender<()>)>>,
    /// The next stranger's number.
    next: Mutex<u64>,
}

/// One connection's place. Clones are the same place; it is free again when the last one is dropped.
#[derive(Clone, Debug)]
pub struct Place(Arc<Held>);

#[derive(Debug)]
struct Held {
    places: Arc<Shared>,
    number: u64,
    known: AtomicBool,
}

/// No place is left for one more known connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0} connections are open, which is the most there may be")]
pub struct AllTaken(pub usize);

impl Places {
    /// As many as this.
    pub fn new(limits: PlaceLimits) -> Self {
        Self(Arc::new(Shared {
            limits,
            known: AtomicUsize::new(0),
            strangers: Mutex::default(),
            next: Mutex::default(),
        }))
    }

    /// A stranger's place. When all are taken, the oldest stranger's connection ends.
    pub fn stranger(&self) -> (Place, Leave) {
        let (end, ended) = oneshot::channel();
        let number = {
            let mut next = self.0.next.lock().unwrap_or_else(PoisonError::into_inner);
            *next += 1;
            *next
        };
        let mut strangers = self.0.strangers();
        if strangers.len() >= self.0.limits.strangers.max(1) {
            // Dropped, its sender ends the connection that waits for it.
            strangers.pop_front();
        }
        strangers.push_back((number, end));
        drop(strangers);
        let held = Held { places: Arc::clone(&self.0), number, known: AtomicBool::new(false) };
        let deadline = Box::pin(tokio::time::sleep(self.0.limits.deadline));
        (Place(Arc::new(held)), Leave { ended: Some(ended), deadline })
    }
}

impl Shared {
    fn strangers(&self) -> MutexGuard<'_, VecDeque<(u64, oneshot::Sender<()>)>> {
        // Nothing that could panic happens under the lock.
        self.strangers.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a stranger out of the list, with the way to end it.
    fn remove(&self, number: u64) -> Option<oneshot::Sender<()>> {
        let mut strangers = self.strangers();
        let at = strangers.iter().position(|(other, _)| *other == number)?;
        strangers.remove(at).map(|(_, end)| end)
    }
}

impl Place {
    /// Makes a stranger known: it has shown what it must. A known one stays so.
    ///
    /// # Errors
    /// When as many are known as may be: it stays a stranger.
    pub fn make_known(&self) -> Result<(), AllTaken> {
        let Held { places, number, known } = &*self.0;
        if known.load(Ordering::Acquire) {
            return Ok(());
        }
        let max = places.limits.known;
        let one_more = |count: usize| (count < max).then_some(count + 1);
        if places.known.fetch_update(Ordering::AcqRel, Ordering::Acquire, one_more).is_err() {
            return Err(AllTaken(max));
        }
        if known.swap(true, Ordering::AcqRel) {
            // Two calls of one connection at once: it has one place all the same.
            places.known.fetch_sub(1, Ordering::AcqRel);
        }
        // The end of its sender means nothing to a known one.
        drop(places.remove(*number));
        Ok(())
    }

    fn is_known(&self) -> bool {
        self.0.known.load(Ordering::Acquire)
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        if *self.known.get_mut() {
            self.places.known.fetch_sub(1, Ordering::AcqRel);
        } else {
            drop(self.places.remove(self.number));
        }
    }
}

/// Comes to its end when a stranger has to go.
#[derive(Debug)]
pub struct Leave {
    /// Nothing once it was told.
    ended: Option<oneshot::Receiver<()>>,
    deadline: Pin<Box<Sleep>>,
}

impl Future for Leave {
    type Output = ();

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<()> {
        // Whether it was told or those that could tell it are gone.
        let has_ended = self.ended.as_mut().is_none_or(|ended| Pin::new(ended).poll(cx).is_ready());
        if has_ended || self.deadline.as_mut().poll(cx).is_ready() {
            self.ended = None;
            return Poll::Ready(());
        }
        Poll::Pending
    }
}

/// A connection that ends when it is a stranger for too long.
#[derive(Debug)]
pub struct Guarded<S> {
    stream: S,
    place: Place,
    /// Nothing once it is known.
    leave: Option<Leave>,
}

impl<S> Guarded<S> {
    /// A stranger's connection.
    pub fn new(stream: S, place: Place, leave: Leave) -> Self {
        Self { stream, place, leave: Some(leave) }
    }

    /// Its place.
    pub fn place(&self) -> &Place {
        &self.place
    }

    /// An error once it has to go.
    fn check(&mut self, cx: &mut Context<'_>) -> io::Result<()> {
        if self.leave.is_some() && self.place.is_known() {
            self.leave = None;
        }
        let has_to_go = self.leave.as_mut().is_some_and(|leave| Pin::new(leave).poll(cx).is_ready());
        // It may have become known just now.
        if has_to_go && !self.place.is_known() {
            return Err(io::Error::new(io::ErrorKind::TimedOut, "it did not authenticate in time"));
        }
        Ok(())
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Guarded<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        if let Err(error) = self.check(cx) {
            return Poll::Ready(Err(error));
        }
        Pin::new(&mut self.stream).poll_read(cx, buffer)
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Guarded<S> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(cx, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::io::AsyncReadExt as _;

    fn places(known: usize, strangers: usize) -> Places {
        Places::new(PlaceLimits { known, strangers, deadline: Duration::from_secs(3600) })
    }

    /// Whether a read ends at once, and with which error.
    async fn ended<S: AsyncRead + Unpin>(connection: &mut Guarded<S>) -> Option<io::ErrorKind> {
        let read = async { connection.read(&mut [0]).await.map_err(|error| error.kind()).err() };
        tokio::select! {
            biased;
            ended = read => ended,
            () = std::future::ready(()) => None,
        }
    }

    #[tokio::test]
    async fn the_oldest_stranger_goes_and_known_callers_stay() {
        let places = places(2, 2);
        let (mine, _theirs) = tokio::io::duplex(1);
        let (place, leave) = places.stranger();
        let mut known = Guarded::new(mine, place.clone(), leave);
        place.make_known().unwrap();
        let mut silent = Vec::new();
        for _ in 0..5 {
            let (mine, theirs) = tokio::io::duplex(1);
            let (place, leave) = places.stranger();
            silent.push((Guarded::new(mine, place, leave), theirs));
        }
        let mut ends = Vec::new();
        for (connection, _) in &mut silent {
            ends.push(ended(connection).await);
        }
        let gone = Some(io::ErrorKind::TimedOut);
        assert_eq!(ends, [gone, gone, gone, None, None]);
        assert_eq!(ended(&mut silent[0].0).await, gone, "and stays so");
        assert_eq!(ended(&mut known).await, None);
        // The newest shows what it must; the next stranger costs the other its place.
        silent[4].0.place().make_known().unwrap();
        let (third, _leave) = places.stranger();
        assert_eq!(ended(&mut silent[3].0).await, None, "there is room for two");
        let _fourth = places.stranger();
        assert_eq!(ended(&mut silent[3].0).await, gone);
        assert_eq!(ended(&mut silent[4].0).await, None);
        // Two are known, which is the most there may be; one that goes makes room.
        assert_eq!(third.make_known(), Err(AllTaken(2)));
        silent.truncate(4);
        third.make_known().unwrap();
        third.make_known().unwrap();
        drop((known, place));
        assert!(places.stranger().0.make_known().is_ok());
    }

    #[tokio::test]
    async fn a_stranger_has_a_deadline_and_one_who_is_known_has_none() {
        let deadline = Duration::from_millis(20);
        let places = Places::new(PlaceLimits { known: 1, strangers: 2, deadline });
        let connection = || {
            let (mine, theirs) = tokio::io::duplex(1);
            let (place, leave) = places.stranger();
            (Guarded::new(mine, place, leave), theirs)
        };
        let ((mut known, _a), (mut silent, _b)) = (connection(), connection());
        known.place().make_known().unwrap();
        // The known one's deadline is the earlier.
        let error = silent.read(&mut [0]).await.unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::TimedOut);
        assert_eq!(ended(&mut known).await, None);
    }
}
