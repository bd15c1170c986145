//! Episode frames over shared memory, from many actor processes to one learner process. The only user of
//! iceoryx2, whose types stay inside, and the only crate with `unsafe` (in `bell`, to map one page).
//!
//! - [`RunSpace`] names a place of its own for one life of a run, a learner's: nothing of another is seen, and
//!   [`RunSpace::remove`] leaves nothing there.
//! - [`EpisodeReceiver`] is the learner's end: it creates the place, waits without polling, and reads frames
//!   where they lie.
//! - [`EpisodeSender`] is an actor's end: one copy into shared memory, then it waits until the learner has
//!   room again. Nothing is overwritten and nothing is dropped silently.
//!
//! ```no_run
//! # use rit_episode::wire::Frame;
//! # use rit_ipc::{EpisodeReceiver, EpisodeSender, Limits, RunSpace};
//! # use std::{error::Error, time::Duration};
//! # fn run(payload_len: usize, frame: Frame, stopping: fn() -> bool) -> Result<(), Box<dyn Error>> {
//! // Every process of the run.
//! let space = RunSpace::new("/tmp/rit-1a2b3c4d".as_ref())?;
//!
//! // The learner, in a thread of its own.
//! let mut receiver = EpisodeReceiver::create(&space, Limits::new(payload_len, 4))?;
//! while !stopping() {
//!     while let Some(frame) = receiver.receive()? {
//!         println!("episode {} of actor {}", frame.header().episode, frame.header().actor);
//!     }
//!     receiver.wait(Duration::from_secs(1))?;
//! }
//!
//! // An actor.
//! let mut sender = EpisodeSender::open(&space, payload_len, Duration::from_secs(10))?;
//! sender.send(&frame, &stopping)?;
//!
//! // The process that started them all, when they have ended.
//! space.remove()?;
//! # Ok(())
//! # }
//! ```
//!
//! # What can go wrong below, and what is done about it
//!
//! | what iceoryx2 and the system do | what is done here |
//! |---|---|
//! | a send without a subscriber succeeds and drops | a sender waits for a learner, and sends until one has taken the frame |
//! | a full /dev/shm kills with SIGBUS at some later write | free space is checked first, a sender's memory is reserved before use |
//! | a killed process keeps its place; a killed subscriber blocks publishers for ever | [`EpisodeReceiver::reap_dead`], [`EpisodeSender::reap_dead`]; a waiting sender does it by itself |
//! | reaping a publisher that was never connected loses what it delivered | only the learner reaps actors, and connects to them first |
//! | a publisher that leaves before the learner connected takes its frames along | see [`EpisodeSender`]: leaving is a conversation |
//! | dead nodes without details are cleaned in the global root | they are skipped, and go with [`RunSpace::remove`] |
//! | a learner killed while it creates the service makes it impossible to create | a lock tells that no process is making it, and the half is removed |
//! | a reaper killed at its work may leave a place taken for ever | the learner's place: [`CreateError::StalePlace`]; an actor's: there are some to spare |
//! | a slice of bytes aligned to 8 takes eight times its length | the payload is a slice of words |
//! | the first node makes a segment that every user may write to | it is closed to others at once, `shared_memory` |
//! | long paths fail with an opaque error or a panic | [`RunSpace::new`] checks the length |
//! | an event's notification may be swallowed, and wakes cost twice as much | the wake-up is a futex of our own, see `bell` |

mod backoff;
#[allow(unsafe_code)]
mod bell;
mod limits;
mod node;
mod receiver;
mod run_space;
mod sender;
mod shared_memory;

pub use limits::Limits;
pub use node::{IceoryxError, Reaped};
pub use receiver::{CreateError, EpisodeReceiver, ReceiveError, ReceivedFrame};
pub use run_space::{DirectoryError, FreshError, RemoveError, RunSpace, RunSpaceError};
pub use sender::{EpisodeSender, OpenError, SendError};
pub use shared_memory::{NoSpace, check_space};
