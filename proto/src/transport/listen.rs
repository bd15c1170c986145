//! Listening sockets, and which connections are let in.

use super::{
    Access, Address, CONNECT_TIMEOUT,
    places::{AllTaken, Guarded, Place, Places},
};
use std::{
    collections::BTreeSet,
    convert::Infallible,
    fs,
    io::{self, ErrorKind},
    net::IpAddr,
    os::unix::fs::{FileTypeExt as _, PermissionsExt as _},
    path::{Path, PathBuf},
    pin::Pin,
    task::{Context, Poll},
    time::{Duration, Instant},
};
use tokio::{
    io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _, ReadBuf},
    net::{TcpListener, TcpStream, UnixListener, UnixStream},
    sync::mpsc,
    task::JoinSet,
};
use tokio_rustls::{TlsAcceptor, server::TlsStream};
use tonic::transport::server::Connected;

/// Longest path of a Unix socket: `sun_path` holds 108 bytes, the last of them zero.
const SOCKET_PATH_MAX: usize = 107;

/// How long nothing is accepted after the system could not: without a pause, running out of files would take all CPU
/// time too.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// How long a learner that was killed may take to be gone.
const DYING_TIMEOUT: Duration = Duration::from_secs(2);

/// From one look whether it is to the next.
const DYING_POLL: Duration = Duration::from_millis(20);

/// Refusals that are remembered as logged.
const LOGGED_MAX: usize = 1000;

/// Bytes of a refused caller that are read at once, until it closes, so that the refusal reaches it.
const LINGER_BYTES: usize = 4 << 10;

/// Why a learner cannot listen.
#[derive(Debug, thiserror::Error)]
pub enum ListenError {
    /// Another process listens there.
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
    /// A name, which may mean several addresses.
    #[error("{0}: a learner listens on an IP address, such as tcp:127.0.0.1:50051")]
    NotAnIp(Address),
    /// The system refused.
    #[error("cannot listen on {address}: {error}")]
    Io {
        /// Where.
        address: Address,
        /// Why.
        error: io::Error,
    },
}

/// Why a connection was not let in.
#[derive(Debug, thiserror::Error)]
pub enum Refused {
    /// Another user's process.
    #[error("it comes from user {0}, and this learner belongs to another")]
    OtherUser(u32),
    /// The system does not say whose it is.
    #[error("the system does not say whose it is: {0}")]
    UnknownUser(io::Error),
    /// All places are taken.
    #[error(transparent)]
    TooMany(#[from] AllTaken),
    /// No TLS, or a certificate that does not do.
    #[error("{ip}: {error}")]
    Tls {
        /// Who called.
        ip: IpAddr,
        /// What was wrong.
        error: io::Error,
    },
}

/// A listening socket.
#[derive(Debug)]
pub struct Incoming {
    socket: Socket,
    address: Address,
}

#[derive(Debug)]
enum Socket {
    Unix(UnixListener),
    Tcp(TcpListener),
}

impl Incoming {
    /// Listens. A socket file that a dead learner has left is replaced.
    ///
    /// # Errors
    /// When another process listens there already, or the system refuses.
    pub async fn bind(address: &Address) -> Result<Self, ListenError> {
        match address {
            Address::Unix(path) => Self::bind_unix(path).await,
            Address::Tcp { host, port } => {
                let ip: IpAddr = host.parse().map_err(|_| ListenError::NotAnIp(address.clone()))?;
                let io = |error: io::Error| match error.kind() {
                    ErrorKind::AddrInUse => ListenError::InUse(address.clone()),
                    _ => ListenError::Io { address: address.clone(), error },
                };
                let listener = TcpListener::bind((ip, *port)).await.map_err(io)?;
                // With a port of 0: the one that was chosen.
                let port = listener.local_addr().map_err(io)?.port();
                let address = Address::Tcp { host: host.clone(), port };
                Ok(Self { socket: Socket::Tcp(listener), address })
            }
        }
    }

    async fn bind_unix(path: &Path) -> Result<Self, ListenError> {
        let address = Address::Unix(path.to_owned());
        let io = |error| ListenError::Io { address: address.clone(), error };
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
            Ok(_) if is_answered(path).await => return Err(ListenError::InUse(address)),
            // No answer: its learner is dead.
            Ok(_) => fs::remove_file(path).map_err(io)?,
        }
        let listener = UnixListener::bind(path).map_err(io)?;
        fs::set_permissions(path, fs::Permissions::from_mode(0o600)).map_err(io)?;
        Ok(Self { socket: Socket::Unix(listener), address })
    }

    /// Where it listens: with a TCP port of 0, the one that was chosen.
    pub fn address(&self) -> &Address {
        &self.address
    }

    /// Passes on the connections that are let in. Each is a stranger's until it has shown what `access` demands. Each
    /// refusal is logged once, however often the same caller comes.
    pub(super) async fn accept(
        &self,
        access: &Access,
        places: &Places,
        connections: &mpsc::Sender<io::Result<Connection>>,
    ) -> Infallible {
        let mut handshakes = JoinSet::new();
        let mut logged = BTreeSet::new();
        loop {
            let let_in = tokio::select! {
                accepted = self.next() => match accepted {
                    Ok((Err(refused), _)) => Err(refused),
                    Ok((Ok(stream), ip)) => {
                        let (place, leave) = places.stranger();
                        match (stream, &access.tls) {
                            (Stream::Tcp(stream), Some(tls)) => {
                                let stream = Guarded::new(stream, place, leave);
                                handshakes.spawn(handshake(stream, ip, tls.clone(), access.by_certificate()));
                                continue;
                            }
                            (Stream::Tcp(stream), None) => {
                                let io = Io::Tcp(Guarded::new(stream, place.clone(), leave));
                                Ok(Connection { io, place })
                            }
                            (Stream::Unix(stream), _) => {
                                let io = Io::Unix(Guarded::new(stream, place.clone(), leave));
                                Ok(Connection { io, place })
                            }
                        }
                    }
                    Err(error) => {
                        if logged.insert(error.to_string()) {
                            tracing::error!(%error, address = %self.address, "cannot accept connections");
                        }
                        tokio::time::sleep(ACCEPT_PAUSE).await;
                        continue;
                    }
                },
                // A handshake that panicked is a connection that is closed.
                Some(Ok(greeted)) = handshakes.join_next() => greeted,
            };
            match let_in {
                Ok(connection) => {
                    // Connections are no longer taken: the server is about to end.
                    let _ = connections.send(Ok(connection)).await;
                }
                Err(refused) => {
                    if logged.len() >= LOGGED_MAX {
                        logged.clear();
                    }
                    if logged.insert(refused.to_string()) {
                        tracing::warn!(%refused, address = %self.address, "refused a connection");
                    }
                }
            }
        }
    }

    /// The next caller: whether it may be heard, and, over TCP, from where it calls.
    async fn next(&self) -> io::Result<(Result<Stream, Refused>, IpAddr)> {
        let here = IpAddr::from([127, 0, 0, 1]);
        Ok(match &self.socket {
            Socket::Unix(listener) => {
                let (stream, _) = listener.accept().await?;
                (check_user(&stream).map(|()| Stream::Unix(stream)), here)
            }
            Socket::Tcp(listener) => {
                let (stream, from) = listener.accept().await?;
                stream.set_nodelay(true)?;
                (Ok(Stream::Tcp(stream)), from.ip().to_canonical())
            }
        })
    }
}

impl Drop for Incoming {
    fn drop(&mut self) {
        if let Address::Unix(path) = &self.address {
            // Gone already is as good.
            let _ = fs::remove_file(path);
        }
    }
}

/// Whether a learner listens there. One that has just been killed does for a moment more.
async fn is_answered(path: &Path) -> bool {
    let begun = Instant::now();
    while UnixStream::connect(path).await.is_ok() {
        if begun.elapsed() >= DYING_TIMEOUT {
            return true;
        }
        tokio::time::sleep(DYING_POLL).await;
    }
    false
}

/// Whether a process of the same user calls.
fn check_user(stream: &UnixStream) -> Result<(), Refused> {
    let peer = stream.peer_cred().map_err(Refused::UnknownUser)?;
    if peer.uid() == rustix::process::geteuid().as_raw() {
        Ok(())
    } else {
        Err(Refused::OtherUser(peer.uid()))
    }
}

/// Greets a caller. Where its certificate is all that it has to show, it is known then.
async fn handshake(
    stream: Guarded<TcpStream>,
    ip: IpAddr,
    tls: TlsAcceptor,
    by_certificate: bool,
) -> Result<Connection, Refused> {
    let place = stream.place().clone();
    match tls.accept(stream).into_fallible().await {
        Ok(stream) => {
            if by_certificate {
                place.make_known()?;
            }
            Ok(Connection { io: Io::Tls(Box::new(stream)), place })
        }
        Err((error, mut stream)) => {
            // Closed with unread bytes, the connection would be reset, and the caller would not learn why: what it
            // still sends is read until it closes.
            let _ = stream.shutdown().await;
            let mut rest = vec![0; LINGER_BYTES];
            let drain = async { while stream.read(&mut rest).await.is_ok_and(|read| read > 0) {} };
            let _ = tokio::time::timeout(CONNECT_TIMEOUT, drain).await;
            Err(Refused::Tls { ip, error })
        }
    }
}

/// Who called, before it is greeted.
enum Stream {
    Unix(UnixStream),
    Tcp(TcpStream),
}

/// A connection that was accepted; it has one of the places until it is dropped.
pub(super) struct Connection {
    io: Io,
    place: Place,
}

enum Io {
    Unix(Guarded<UnixStream>),
    Tcp(Guarded<TcpStream>),
    Tls(Box<TlsStream<Guarded<TcpStream>>>),
}

/// What both directions need: the stream inside, pinned.
trait ReadWrite: AsyncRead + AsyncWrite + Unpin {}
impl<T: AsyncRead + AsyncWrite + Unpin> ReadWrite for T {}

impl Connection {
    fn stream(self: Pin<&mut Self>) -> Pin<&mut dyn ReadWrite> {
        let stream: &mut dyn ReadWrite = match &mut self.get_mut().io {
            Io::Unix(stream) => stream,
            Io::Tcp(stream) => stream,
            Io::Tls(stream) => stream,
        };
        Pin::new(stream)
    }
}

impl Connected for Connection {
    type ConnectInfo = Place;

    fn connect_info(&self) -> Place {
        self.place.clone()
    }
}

impl AsyncRead for Connection {
    fn poll_read(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.stream().poll_read(cx, buffer)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        self.stream().poll_write(cx, bytes)
    }

    fn poll_flush(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.stream().poll_flush(cx)
    }

    fn poll_shutdown(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.stream().poll_shutdown(cx)
    }
}
