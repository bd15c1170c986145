//! A client's connection to a game: requests and responses in binary frames of a WebSocket, each waited for until its
//! deadline.

use crate::messages::{Request, Response, Status, request, response};
use prost::Message as _;
use std::{
    collections::VecDeque,
    io::{self, Read, Write},
    net::{SocketAddr, TcpStream},
    time::{Duration, Instant},
};
use tungstenite::{Error, HandshakeError, Message, WebSocket, handshake::client::ClientHandshake};

/// Where the API is on the game's web server.
pub(crate) const PATH: &str = "/sc2api";

/// How long a connection may take to come about, at most.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// What the answer of one that does not speak this protocol is shown of, in characters at most.
const SHOWN_MAX: usize = 300;

/// What can go wrong between a client and a game.
#[derive(Debug, thiserror::Error)]
pub enum ConnectionError {
    /// There is no listener yet, or the API is not there yet: a game that starts up.
    #[error("{address} does not answer yet: {reason}")]
    NotReady {
        /// Where.
        address: SocketAddr,
        /// What came instead.
        reason: String,
    },
    /// It took too long.
    #[error("no answer to {request} within {} s", after.as_secs_f64())]
    TimedOut {
        /// What was asked.
        request: &'static str,
        /// How long it was waited for.
        after: Duration,
    },
    /// The game, or whatever is there, has closed the connection.
    #[error("the connection closed during {request}: {reason}")]
    Closed {
        /// What was asked.
        request: &'static str,
        /// How that showed.
        reason: String,
    },
    /// What came is no response.
    #[error("the answer to {request} is not a StarCraft II response: {reason}")]
    Garbage {
        /// What was asked.
        request: &'static str,
        /// What is wrong with it.
        reason: String,
    },
    /// The game says that a request was out of place.
    #[error("the game refuses {request}: {reason}")]
    Refused {
        /// What was asked.
        request: &'static str,
        /// In its own words.
        reason: String,
    },
}

/// A stream whose reads and writes end at a deadline, however slowly bytes trickle in.
#[derive(Debug)]
struct Timed {
    stream: TcpStream,
    deadline: Instant,
}

impl Timed {
    fn left(&self) -> io::Result<Option<Duration>> {
        match self.deadline.saturating_duration_since(Instant::now()) {
            Duration::ZERO => Err(io::ErrorKind::TimedOut.into()),
            left => Ok(Some(left)),
        }
    }
}

/// The system says "would block" where a timeout has passed.
fn timed<T>(result: io::Result<T>) -> io::Result<T> {
    result.map_err(|error| match error.kind() {
        io::ErrorKind::WouldBlock => io::ErrorKind::TimedOut.into(),
        _ => error,
    })
}

impl Read for Timed {
    fn read(&mut self, to: &mut [u8]) -> io::Result<usize> {
        self.stream.set_read_timeout(self.left()?)?;
        timed(self.stream.read(to))
    }
}

impl Write for Timed {
    fn write(&mut self, from: &[u8]) -> io::Result<usize> {
        self.stream.set_write_timeout(self.left()?)?;
        timed(self.stream.write(from))
    }

    fn flush(&mut self) -> io::Result<()> {
        self.stream.flush()
    }
}

/// A connection to a game.
#[derive(Debug)]
pub struct Connection {
    socket: WebSocket<Timed>,
    timeout: Duration,
    next_id: u32,
    /// Requests on their way, oldest first: the game answers in order.
    pending: VecDeque<(u32, &'static str)>,
    /// As the last response had it.
    status: Status,
}

impl Connection {
    /// Connects to the game that listens there; each answer is then waited for so long.
    ///
    /// # Errors
    /// When there is no listener, or another program listens.
    pub fn open(address: SocketAddr, timeout: Duration) -> Result<Self, ConnectionError> {
        const REQUEST: &str = "the handshake";
        let connecting = CONNECT_TIMEOUT.min(timeout);
        let not_ready =
            |reason: &dyn ToString| ConnectionError::NotReady { address, reason: reason.to_string() };
        let stream = TcpStream::connect_timeout(&address, connecting).map_err(|error| not_ready(&error))?;
        // Small messages to and fro: none waits for another.
        stream.set_nodelay(true).map_err(|error| not_ready(&error))?;
        let stream = Timed { stream, deadline: Instant::now() + connecting };
        let upgraded = tungstenite::client(format!("ws://{address}{PATH}"), stream);
        let (socket, _) = upgraded.map_err(|error: HandshakeError<ClientHandshake<Timed>>| match error {
            HandshakeError::Failure(Error::Io(error)) if error.kind() == io::ErrorKind::TimedOut => {
                ConnectionError::TimedOut { request: REQUEST, after: connecting }
            }
            // The game listens before its API is there.
            HandshakeError::Failure(Error::Io(error)) => not_ready(&error),
            HandshakeError::Failure(Error::Http(answer)) if answer.status() == 404 => {
                not_ready(&format!("HTTP {}", answer.status()))
            }
            error => ConnectionError::Garbage { request: REQUEST, reason: shown(&error) },
        })?;
        Ok(Self { socket, timeout, next_id: 1, pending: VecDeque::new(), status: Status::Launched })
    }

    /// The game's state, as its last response had it.
    pub fn status(&self) -> Status {
        self.status
    }

    /// Sends a request; [`Self::receive`] gives its response. Several may be on their way.
    ///
    /// # Errors
    /// When it cannot be sent in time.
    pub fn send(&mut self, request: request::Request) -> Result<(), ConnectionError> {
        let (id, name) = (self.next_id, request.name());
        self.next_id = self.next_id.wrapping_add(1);
        let bytes = Request { request: Some(request), id: Some(id) }.encode_to_vec();
        self.socket.get_mut().deadline = Instant::now() + self.timeout;
        self.socket.send(Message::Binary(bytes.into())).map_err(|error| self.lost(name, error))?;
        self.pending.push_back((id, name));
        Ok(())
    }

    /// Waits for the response to the oldest request that is on its way.
    ///
    /// # Errors
    /// When it does not come in time, or is not one.
    pub fn receive(&mut self) -> Result<response::Response, ConnectionError> {
        let Some((id, request)) = self.pending.pop_front() else {
            return Err(ConnectionError::Garbage { request: "nothing", reason: "nothing was asked".into() });
        };
        self.socket.get_mut().deadline = Instant::now() + self.timeout;
        let bytes = loop {
            match self.socket.read().map_err(|error| self.lost(request, error))? {
                Message::Binary(bytes) => break bytes,
                Message::Ping(_) | Message::Pong(_) | Message::Frame(_) => {}
                Message::Close(_) => {
                    return Err(ConnectionError::Closed {
                        request,
                        reason: "it closed the connection".into(),
                    });
                }
                Message::Text(text) => {
                    let reason = format!("text, {}", shown(&text));
                    return Err(ConnectionError::Garbage { request, reason });
                }
            }
        };
        read_response(&bytes, request, id, &mut self.status)
    }

    /// Sends a request and waits for its response, which must be the only one on its way.
    ///
    /// # Errors
    /// As [`Self::send`] and [`Self::receive`].
    pub fn ask(&mut self, request: request::Request) -> Result<response::Response, ConnectionError> {
        self.send(request)?;
        self.receive()
    }

    fn lost(&self, request: &'static str, error: Error) -> ConnectionError {
        match error {
            Error::Io(error) if error.kind() == io::ErrorKind::TimedOut => {
                ConnectionError::TimedOut { request, after: self.timeout }
            }
            Error::Io(error) => ConnectionError::Closed { request, reason: error.to_string() },
            Error::ConnectionClosed | Error::AlreadyClosed => {
                ConnectionError::Closed { request, reason: "the other side has gone".into() }
            }
            Error::Protocol(tungstenite::error::ProtocolError::ResetWithoutClosingHandshake) => {
                ConnectionError::Closed { request, reason: "the connection was reset".into() }
            }
            error => ConnectionError::Garbage { request, reason: shown(&error) },
        }
    }
}

/// Reads a message as the response to the request of this name and number, and the game's state from it.
///
/// # Errors
/// When it is none, or refuses the request.
pub fn read_response(
    bytes: &[u8],
    request: &'static str,
    id: u32,
    status: &mut Status,
) -> Result<response::Response, ConnectionError> {
    let garbage = |reason: String| ConnectionError::Garbage { request, reason };
    let response = Response::decode(bytes).map_err(|error| garbage(error.to_string()))?;
    if response.id.is_some_and(|theirs| theirs != id) {
        return Err(garbage(format!("it has the number {}, not {id}", response.id())));
    }
    if response.status.is_none() {
        return Err(garbage("it has no status".into()));
    }
    *status = response.status();
    match response.response {
        Some(body) if body.name() == request => {
            if !response.error.is_empty() {
                tracing::warn!(request, errors = ?response.error, "the game warns");
            }
            Ok(body)
        }
        Some(body) => Err(garbage(format!("it answers {}", body.name()))),
        None if response.error.is_empty() => Err(garbage("it is empty".into())),
        None => Err(ConnectionError::Refused { request, reason: shown(&response.error.join("; ")) }),
    }
}

/// Words from outside: no longer than needs be, on one line.
pub(crate) fn shown(words: &dyn ToString) -> String {
    let words = words.to_string();
    words.chars().take(SHOWN_MAX).map(|c| if c.is_control() { ' ' } else { c }).collect()
}
