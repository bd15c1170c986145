//! Addresses, and how to listen and connect, so that only those get in who may.
//!
//! A Unix socket in the run directory is always there: its folder has mode 700, it has mode 600 itself, the system is
//! asked who calls, and the caller must know the run's token. TCP is there when the configuration asks for it, and then:
//!
//! | listens on | what callers must show |
//! |---|---|
//! | any address | a certificate of the client authority (mTLS), or a token inside TLS, or both |
//! | loopback | the same, or a token without TLS |
//!
//! A token in clear text over a network would be no secret, so neither side ever sends or takes one there.

mod access;
mod address;
mod connect;
mod files;
mod listen;
mod places;
mod serve;
#[cfg(test)]
mod tests;
mod words;

pub use access::{Access, AccessError, AccessFiles, is_secret};
pub use address::{Address, AddressError};
pub use connect::{Client, ConnectError, CredentialFiles, Credentials, CredentialsError, connect};
pub use files::{FileError, check_private};
pub use listen::{Incoming, ListenError};
pub use places::{AllTaken, Guarded, Leave, Place, PlaceLimits, Places};
pub use serve::{CONNECTIONS_MAX, REQUEST_BYTES_MAX, ServeLimits, serve};
pub use words::status_words;

use std::time::Duration;

/// What HTTP/2 is called in a TLS handshake.
const ALPN_HTTP2: &[u8] = b"h2";

/// How long connecting, and greeting a caller, may take.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// How long a caller may take to show that it may speak.
pub const STRANGER_DEADLINE: Duration = Duration::from_secs(10);

/// How long most calls may take: their answers are at hand.
const CALL_TIMEOUT: Duration = Duration::from_secs(10);

/// How long a call may take that works: an evaluation, a checkpoint.
const LONG_CALL_TIMEOUT: Duration = Duration::from_secs(600);

/// Longest HTTP/2 frame that a caller takes. A learner of small batches sends its weights thousands of times a minute,
/// and HTTP/2's own 16 KiB would cut each piece of them into dozens of frames, with a system call or two for each.
const FRAME_BYTES_MAX: u32 = 2 * crate::snapshot::PIECE_BYTES as u32;

/// When the other side has been silent for so long, it is pinged.
const KEEPALIVE_EVERY: Duration = Duration::from_secs(5);

/// Without an answer to that for so long, the link is dead. Longer than a slow link needs for what is before the ping.
const KEEPALIVE_TIMEOUT: Duration = Duration::from_secs(10);
