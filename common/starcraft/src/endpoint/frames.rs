//! The endpoint's side of a WebSocket. The published Python client sends its messages as text that is not UTF-8, so
//! frames are put together here, where text is as good as binary.

use crate::connection::PATH;
use std::{io, net::TcpStream, time::Duration};
use tungstenite::{
    Error, HandshakeError,
    handshake::server::{Callback, ErrorResponse, Request, Response},
    http::StatusCode,
    protocol::frame::{
        Frame, FrameSocket,
        coding::{Control, Data, OpCode},
    },
};

/// Longest message: a map and a little more.
const MESSAGE_MAX: usize = 64 << 20;

/// How long a client may take to say what it wants.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(10);

/// What can go wrong with a client's connection.
#[derive(Debug, thiserror::Error)]
pub enum FramesError {
    /// No WebSocket came about.
    #[error("no WebSocket: {0}")]
    Handshake(String),
    /// What came is none of a WebSocket.
    #[error(transparent)]
    WebSocket(#[from] Error),
    /// Parts of a message out of order.
    #[error("a part of a message that has not begun, or that has not ended")]
    Order,
    /// A message that no client needs.
    #[error("a message of more than {MESSAGE_MAX} bytes")]
    TooLong,
    /// The socket.
    #[error(transparent)]
    Io(#[from] io::Error),
}

/// A client's connection.
#[derive(Debug)]
pub struct Frames(FrameSocket<TcpStream>);

/// Lets those in that ask for the API.
struct AtPath;

impl Callback for AtPath {
    fn on_request(self, request: &Request, response: Response) -> Result<Response, ErrorResponse> {
        if request.uri().path() == PATH {
            return Ok(response);
        }
        let mut refusal = ErrorResponse::new(None);
        *refusal.status_mut() = StatusCode::NOT_FOUND;
        Err(refusal)
    }
}

impl Frames {
    /// Answers the handshake of a client.
    ///
    /// # Errors
    /// When it wants something else, or takes too long to say what.
    pub fn accept(stream: TcpStream) -> Result<Self, FramesError> {
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(HANDSHAKE_TIMEOUT))?;
        let socket = tungstenite::accept_hdr(stream, AtPath).map_err(|error| match error {
            HandshakeError::Failure(error) => FramesError::Handshake(error.to_string()),
            HandshakeError::Interrupted(_) => FramesError::Handshake("it says nothing".into()),
        })?;
        let stream = socket.get_ref().try_clone()?;
        // From now on a client may think as long as it likes.
        stream.set_read_timeout(None)?;
        Ok(Self(FrameSocket::new(stream)))
    }

    /// The next message; `None` when the client has gone.
    ///
    /// # Errors
    /// When what comes is no message.
    pub fn receive(&mut self) -> Result<Option<Vec<u8>>, FramesError> {
        let mut message: Option<Vec<u8>> = None;
        loop {
            let Some(frame) = self.0.read(Some(MESSAGE_MAX))? else { return Ok(None) };
            let (header, mask) = (frame.header().clone(), frame.header().mask);
            let mut payload = frame.into_payload().to_vec();
            if let Some(mask) = mask {
                payload.iter_mut().zip(mask.into_iter().cycle()).for_each(|(byte, mask)| *byte ^= mask);
            }
            match (header.opcode, &mut message) {
                (OpCode::Data(Data::Text | Data::Binary), None) => message = Some(payload),
                (OpCode::Data(Data::Continue), Some(begun)) => begun.append(&mut payload),
                (OpCode::Control(Control::Ping), _) => {
                    self.0.send(Frame::pong(payload))?;
                    continue;
                }
                (OpCode::Control(Control::Close), _) => {
                    // A client that closes its connection may be gone before the answer.
                    let _ = self.0.send(Frame::close(None));
                    return Ok(None);
                }
                (OpCode::Control(_), _) => continue,
                (OpCode::Data(_), _) => return Err(FramesError::Order),
            }
            if message.as_ref().is_some_and(|message| message.len() > MESSAGE_MAX) {
                return Err(FramesError::TooLong);
            }
            if header.is_final {
                return Ok(message);
            }
        }
    }

    /// Sends a message, as binary.
    ///
    /// # Errors
    /// When the client has gone.
    pub fn send(&mut self, message: Vec<u8>) -> Result<(), FramesError> {
        Ok(self.0.send(Frame::message(message, OpCode::Data(Data::Binary), true))?)
    }
}
