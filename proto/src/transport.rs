//! Addresses, and how to listen and connect. A Unix socket in the run directory is the default: only the same
//! user gets through. TCP is an option. Either way a caller must know the run's token.

use std::{
    fmt, fs,
    io::{self, ErrorKind},
    net::SocketAddr,
    os::unix::fs::{FileTypeExt as _, PermissionsExt as _},
    path::{Path, PathBuf},
    pin::Pin,
    str::FromStr,
    task::{Context, Poll},
    time::Duration,
};
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    net::{TcpListener, TcpStream, UnixListener, UnixStream},
};
use tokio_stream::Stream;
use tonic::{
    Request, Status,
    metadata::{Ascii, MetadataValue},
    service::{Interceptor, interceptor::InterceptedService},
    transport::{Channel, Endpoint, server::Connected},
};

/// Longest path of a Unix socket: `sun_path` holds 108 bytes, the last of them zero.
const SOCKET_PATH_MAX: usize = 107;

/// How long connecting may take.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// Where a learner listens.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Address {
    /// A Unix socket.
    Unix(PathBuf),
    /// A TCP address.
    Tcp(SocketAddr),
}

/// A text that is no address.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no address; write unix:PATH or tcp:IP:PORT, such as tcp:127.0.0.1:50051")]
pub struct AddressError(String);

impl FromStr for Address {
    type Err = AddressError;

    fn from_str(text: &str) -> Result<Self, AddressError> {
        let error = || AddressError(text.to_owned());
        match text.split_once(':') {
            Some(("unix", path)) if !path.is_empty() => Ok(Self::Unix(path.into())),
            Some(("tcp", address)) => address.parse().map(Self::Tcp).map_err(|_| error()),
            _ => Err(error()),
        }
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unix(path) => write!(f, "unix:{}", path.display()),
            Self::Tcp(address) => write!(f, "tcp:{address}"),
        }
    }
}

/// Why a learner cannot listen.
#[derive(Debug, thiserror::Error)]
pub enum ListenError {
    /// Somebody answers there.
    #[error("{0} is in use: another learner listens there; choose another run directory or address")]
    InUse(Address),
    /// The socket's path does not fit.
    #[error(
        "the socket's path {path} has {len} bytes, at most {SOCKET_PATH_MAX} fit; choose a shorter run directory"
    )]
    PathTooLong {
        /// The path.
        path: PathBuf,
        /// Its length.
        len: usize,
    },
    /// Something else than a socket lies at the path.
    #[error("{0} is not a socket; move it away")]
    NotASocket(PathBuf),
    /// The system refused.
    #[error("cannot listen on {address}: {error}")]
    Io {
        /// Where.
        address: Address,
        /// Why.
        error: io::Error,
    },
}

/// Why a learner cannot be reached.
#[derive(Debug, thiserror::Error)]
#[error("no learner answers on {address}; is the run still going? ({reason})")]
pub struct ConnectError {
    /// Where it was expected.
    pub address: Address,
    /// What the connection said.
    pub reason: String,
}

/// What clients speak through: a connection, and the run's token on every call.
pub type Client = InterceptedService<Channel, Bearer>;

/// Puts the run's token on every call.
#[derive(Clone, Debug)]
pub struct Bearer(Option<MetadataValue<Ascii>>);

impl Bearer {
    /// Of this token.
    pub fn new(token: &str) -> Self {
        // A token that is no header is no token of ours: the call goes out without, and is refused.
        Self(format!("Bearer {token}").parse().ok())
    }
}

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(value) = &self.0 {
            request.metadata_mut().insert("authorization", value.clone());
        }
        Ok(request)
    }
}

/// Lets only callers through that know the run's token.
#[derive(Clone, Debug)]
pub struct Guard(String);

impl Guard {
    /// Of this token.
    pub fn new(token: &str) -> Self {
        Self(format!("Bearer {token}"))
    }
}

impl Interceptor for Guard {
    fn call(&mut self, request: Request<()>) -> Result<Request<()>, Status> {
        let given = request.metadata().get("authorization").map_or(&[][..], |value| value.as_bytes());
        let known = self.0.as_bytes();
        // Looks at every byte, whatever the first ones are.
        let differs =
            given.iter().zip(known).fold(given.len() ^ known.len(), |all, (a, b)| all | usize::from(a ^ b));
        if differs == 0 {
            Ok(request)
        } else {
            Err(Status::unauthenticated(
                "the call does not carry this run's token; it lies in the run directory",
            ))
        }
    }
}

/// Connects to a learner.
///
/// # Errors
/// When nobody answers there.
pub async fn connect(address: &Address, token: &str) -> Result<Client, ConnectError> {
    let error =
        |reason: &dyn fmt::Display| ConnectError { address: address.clone(), reason: reason.to_string() };
    let uri = match address {
        Address::Unix(path) => format!("unix:{}", path.display()),
        Address::Tcp(address) => format!("http://{address}"),
    };
    let endpoint = Endpoint::try_from(uri).map_err(|invalid| error(&invalid))?;
    let endpoint = endpoint.connect_timeout(CONNECT_TIMEOUT).tcp_nodelay(true);
    let channel = endpoint.connect().await.map_err(|refused| error(&innermost(&refused)))?;
    Ok(InterceptedService::new(channel, Bearer::new(token)))
}

/// The cause at the end of a chain of errors: what a person can act on.
fn innermost(error: &dyn std::error::Error) -> String {
    error.source().map_or_else(|| error.to_string(), innermost)
}

/// A listening socket. On a Unix socket only processes of the same user get through.
pub enum Incoming {
    /// A Unix socket, removed when dropped.
    Unix(UnixListener, PathBuf),
    /// A TCP socket.
    Tcp(TcpListener),
}

impl Incoming {
    /// Listens. A Unix socket left behind by a dead learner is replaced; its mode is 0600.
    ///
    /// # Errors
    /// When somebody else listens there or the system refuses.
    pub async fn bind(address: &Address) -> Result<Self, ListenError> {
        match address {
            Address::Unix(path) => Self::bind_unix(path).await,
            Address::Tcp(socket) => match TcpListener::bind(socket).await {
                Ok(listener) => Ok(Self::Tcp(listener)),
                Err(error) if error.kind() == ErrorKind::AddrInUse => {
                    Err(ListenError::InUse(address.clone()))
                }
                Err(error) => Err(ListenError::Io { address: address.clone(), error }),
            },
        }
    }

    async fn bind_unix(path: &Path) -> Result<Self, ListenError> {
        let address = || Address::Unix(path.to_owned());
        let io = |error| ListenError::Io { address: address(), error };
        let len = path.as_os_str().len();
        if len > SOCKET_PATH_MAX {
            return Err(ListenError::PathTooLong { path: path.to_owned(), len });
        }
        match fs::symlink_metadata(path) {
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            Err(error) => return Err(io(error)),
            Ok(metadata) if !metadata.file_type().is_socket() => {
                return Err(ListenError::NotASocket(path.to_owned()));
            }
            Ok(_) if UnixStream::connect(path).await.is_ok() => return Err(ListenError::InUse(address())),
            // Nobody answers: its learner is dead.
            Ok(_) => fs::remove_file(path).map_err(io)?,
        }
        let listener = UnixListener::bind(path).map_err(io)?;
        fs::set_permissions(path, fs::Permissions::from_mode(0o600)).map_err(io)?;
        Ok(Self::Unix(listener, path.to_owned()))
    }

    /// Where it listens: with a TCP port of 0, the one that was chosen.
    ///
    /// # Errors
    /// When the system does not say.
    pub fn address(&self) -> io::Result<Address> {
        match self {
            Self::Unix(_, path) => Ok(Address::Unix(path.clone())),
            Self::Tcp(listener) => listener.local_addr().map(Address::Tcp),
        }
    }
}

impl Drop for Incoming {
    fn drop(&mut self) {
        if let Self::Unix(_, path) = self {
            // Gone already is as good.
            let _ = fs::remove_file(path);
        }
    }
}

impl Stream for Incoming {
    type Item = io::Result<Connection>;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        match self.get_mut() {
            Self::Unix(listener, _) => loop {
                let (stream, _) = match std::task::ready!(listener.poll_accept(context)) {
                    Ok(accepted) => accepted,
                    Err(error) => return Poll::Ready(Some(Err(error))),
                };
                match stream.peer_cred() {
                    Ok(peer) if peer.uid() == rustix::process::geteuid().as_raw() => {
                        return Poll::Ready(Some(Ok(Connection::Unix(stream))));
                    }
                    peer => tracing::warn!(?peer, "refused a connection of another user"),
                }
            },
            Self::Tcp(listener) => listener.poll_accept(context).map(|accepted| {
                Some(accepted.and_then(|(stream, _)| {
                    stream.set_nodelay(true)?;
                    Ok(Connection::Tcp(stream))
                }))
            }),
        }
    }
}

/// One accepted connection.
pub enum Connection {
    /// Of a process of the same user.
    Unix(UnixStream),
    /// Of anybody who can reach the port.
    Tcp(TcpStream),
}

impl Connected for Connection {
    type ConnectInfo = ();

    fn connect_info(&self) {}
}

impl AsyncRead for Connection {
    fn poll_read(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        match self.get_mut() {
            Self::Unix(stream) => Pin::new(stream).poll_read(cx, buffer),
            Self::Tcp(stream) => Pin::new(stream).poll_read(cx, buffer),
        }
    }
}

impl AsyncWrite for Connection {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        match self.get_mut() {
            Self::Unix(stream) => Pin::new(stream).poll_write(cx, bytes),
            Self::Tcp(stream) => Pin::new(stream).poll_write(cx, bytes),
        }
    }

    fn poll_flush(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        match self.get_mut() {
            Self::Unix(stream) => Pin::new(stream).poll_flush(cx),
            Self::Tcp(stream) => Pin::new(stream).poll_flush(cx),
        }
    }

    fn poll_shutdown(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        match self.get_mut() {
            Self::Unix(stream) => Pin::new(stream).poll_shutdown(cx),
            Self::Tcp(stream) => Pin::new(stream).poll_shutdown(cx),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_lead_back() {
        for text in ["unix:/run/rit/learner.sock", "tcp:127.0.0.1:50051", "tcp:[::1]:0"] {
            assert_eq!(text.parse::<Address>().unwrap().to_string(), text);
        }
        for text in ["", "unix:", "tcp:localhost", "http://127.0.0.1:1", "127.0.0.1:1"] {
            assert!(text.parse::<Address>().unwrap_err().to_string().contains("is no address"), "{text}");
        }
    }

    #[tokio::test]
    async fn a_socket_in_use_is_refused_and_a_stale_one_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let address = Address::Unix(folder.path().join("learner.sock"));
        let first = Incoming::bind(&address).await.unwrap();
        let Address::Unix(path) = &address else { unreachable!() };
        assert_eq!(fs::metadata(path).unwrap().permissions().mode() & 0o777, 0o600);
        assert!(matches!(Incoming::bind(&address).await, Err(ListenError::InUse(_))));
        drop(first);
        assert!(!path.exists());
        // What a killed learner leaves: a socket file that nobody listens on.
        drop(std::os::unix::net::UnixListener::bind(path).unwrap());
        Incoming::bind(&address).await.unwrap();

        fs::write(path, "not a socket").unwrap();
        assert!(matches!(Incoming::bind(&address).await, Err(ListenError::NotASocket(_))));
        let long = Address::Unix(folder.path().join("x".repeat(100)));
        assert!(matches!(Incoming::bind(&long).await, Err(ListenError::PathTooLong { .. })));
    }

    #[tokio::test]
    async fn a_tcp_port_in_use_is_refused() {
        let first = Incoming::bind(&"tcp:127.0.0.1:0".parse().unwrap()).await.unwrap();
        let address = first.address().unwrap();
        assert!(matches!(Incoming::bind(&address).await, Err(ListenError::InUse(_))));
    }

    #[tokio::test]
    async fn nobody_there_is_said_plainly() {
        let folder = tempfile::tempdir().unwrap();
        let address = Address::Unix(folder.path().join("learner.sock"));
        let error = connect(&address, "token").await.unwrap_err().to_string();
        assert!(error.starts_with("no learner answers on unix:"), "{error}");
        assert!(error.contains("No such file"), "{error}");
    }

    #[tokio::test]
    async fn a_message_passes_over_either_and_only_with_the_token() {
        use tonic_health::pb::{HealthCheckRequest, health_client::HealthClient};
        let folder = tempfile::tempdir().unwrap();
        for address in [Address::Unix(folder.path().join("l.sock")), "tcp:127.0.0.1:0".parse().unwrap()] {
            let incoming = Incoming::bind(&address).await.unwrap();
            let address = incoming.address().unwrap();
            let (_, health) = tonic_health::server::health_reporter();
            let guarded = InterceptedService::new(health, Guard::new("secret"));
            let server = tonic::transport::Server::builder().add_service(guarded);
            tokio::spawn(server.serve_with_incoming(incoming));
            for (token, passes) in [("secret", true), ("secreT", false), ("secrets", false), ("", false)] {
                let mut client = HealthClient::new(connect(&address, token).await.unwrap());
                let answer = client.check(HealthCheckRequest { service: String::new() }).await;
                assert_eq!(answer.is_ok(), passes, "{address} {token:?}");
                let refused = answer.err().map(|status| status.code());
                assert_eq!(refused, (!passes).then_some(tonic::Code::Unauthenticated));
            }
        }
    }
}
