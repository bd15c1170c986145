//! Connecting to a learner.

use super::{
    ALPN_HTTP2, Address, CALL_TIMEOUT, CONNECT_TIMEOUT, FRAME_BYTES_MAX, KEEPALIVE_EVERY, KEEPALIVE_TIMEOUT,
    LONG_CALL_TIMEOUT,
    files::{FileError, read_authorities, read_certificates, read_key, read_token},
    words,
};
use hyper_util::rt::TokioIo;
use std::{error::Error, fmt, io, path::PathBuf, sync::Arc, time::Duration};
use tokio::{
    io::{AsyncBufReadExt as _, BufReader},
    net::TcpStream,
};
use tokio_rustls::{
    TlsConnector,
    client::TlsStream,
    rustls::{self, ClientConfig, crypto::ring, pki_types::ServerName, version::TLS13},
};
use tonic::{
    Code, GrpcMethod, Request, Status,
    metadata::{Ascii, MetadataValue},
    service::{Interceptor, interceptor::InterceptedService},
    transport::{Channel, Endpoint},
};
use tonic_health::pb::{HealthCheckRequest, health_client::HealthClient};
use tower::service_fn;

/// The files that a caller shows what they hold of.
#[derive(Clone, Debug, Default)]
pub struct CredentialFiles {
    /// The token that the learner demands.
    pub token: Option<PathBuf>,
    /// The authority of the learner's certificate. Without it there is no TLS.
    pub ca: Option<PathBuf>,
    /// The caller's certificate.
    pub certificate: Option<PathBuf>,
    /// Its key.
    pub key: Option<PathBuf>,
}

/// Why a caller's credentials cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CredentialsError {
    /// A certificate without a key, or the other way round, or either without the learner's authority.
    #[error("--tls-{0} is missing: --tls-certificate and --tls-key belong together, and to --tls-ca")]
    Incomplete(&'static str),
    /// A file cannot be used.
    #[error(transparent)]
    File(#[from] FileError),
    /// Key and certificate do not belong together, or cannot be used.
    #[error("--tls-certificate and --tls-key: {0}")]
    Tls(#[from] rustls::Error),
}

/// What a caller shows.
#[derive(Clone, Default)]
pub struct Credentials {
    token: Option<MetadataValue<Ascii>>,
    tls: Option<TlsConnector>,
}

impl fmt::Debug for Credentials {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Neither token nor key.
        f.debug_struct("Credentials")
            .field("token", &self.token.is_some())
            .field("tls", &self.tls.is_some())
            .finish()
    }
}

impl Credentials {
    /// A token alone.
    pub fn token(token: &str) -> Self {
        // A token that is no header is no token of ours: the call goes out without, and is refused.
        let mut token: Option<MetadataValue<Ascii>> = format!("Bearer {token}").parse().ok();
        if let Some(token) = &mut token {
            token.set_sensitive(true);
        }
        Self { token, tls: None }
    }

    /// What these files hold.
    ///
    /// # Errors
    /// When one cannot be used, or one is missing.
    pub fn read(files: &CredentialFiles) -> Result<Self, CredentialsError> {
        let CredentialFiles { token, ca, certificate, key } = files;
        let token = token.as_deref().map(read_token).transpose()?;
        let identity = match (certificate, key) {
            (Some(certificate), Some(key)) => Some((read_certificates(certificate)?, read_key(key)?)),
            (None, None) => None,
            (Some(_), None) => return Err(CredentialsError::Incomplete("key")),
            (None, Some(_)) => return Err(CredentialsError::Incomplete("certificate")),
        };
        let Some(ca) = ca else {
            return match identity {
                Some(_) => Err(CredentialsError::Incomplete("ca")),
                None => Ok(token.map_or_else(Self::default, |token| Self::token(&token))),
            };
        };
        // Both ends are this program: nothing older is ever needed.
        let config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_protocol_versions(&[&TLS13])?
            .with_root_certificates(read_authorities(ca)?);
        let mut config = match identity {
            Some((certificates, key)) => config.with_client_auth_cert(certificates, key)?,
            None => config.with_no_client_auth(),
        };
        config.alpn_protocols = vec![ALPN_HTTP2.to_vec()];
        let tls = Some(TlsConnector::from(Arc::new(config)));
        Ok(Self { tls, ..token.map_or_else(Self::default, |token| Self::token(&token)) })
    }
}

/// Why a learner cannot be spoken to.
#[derive(Debug, thiserror::Error)]
pub enum ConnectError {
    /// No answer comes from there, or the connection is closed.
    #[error("no learner answers on {address}; is the run still going? ({reason})")]
    NoAnswer {
        /// Where it was expected.
        address: Address,
        /// What the connection said.
        reason: String,
    },
    /// What is sent would be readable on its way.
    #[error("{0} is on another host: without --tls-ca everything would cross the network in clear text")]
    ClearText(Address),
    /// The program that answers has no certificate of the authority given.
    #[error(
        "the program that answers on {address} does not prove to be the learner ({reason}); is --tls-ca its authority?"
    )]
    Untrusted {
        /// Who answered.
        address: Address,
        /// What is wrong with its certificate.
        reason: String,
    },
    /// The learner demands a certificate, and another one than was shown.
    #[error(
        "the learner on {address} refuses this caller's certificate ({reason}); give one of its \
         learner.tls.client_ca with --tls-certificate and --tls-key"
    )]
    Certificate {
        /// The learner.
        address: Address,
        /// What it said.
        reason: String,
    },
    /// The learner demands a token, and another one than was shown.
    #[error(
        "the learner on {0} refuses this caller's token; give the one of its learner.token_file with --token-file"
    )]
    Token(Address),
    /// The learner has as much to do as it takes on.
    #[error("the learner on {address} is busy: {reason}")]
    Busy {
        /// The learner.
        address: Address,
        /// What it said.
        reason: String,
    },
}

impl ConnectError {
    /// Whether it may be different after a while.
    pub fn may_pass(&self) -> bool {
        matches!(self, Self::NoAnswer { .. } | Self::Busy { .. })
    }
}

/// What clients speak through: a connection, and token and deadline on every call.
pub type Client = InterceptedService<Channel, EveryCall>;

/// Puts the token and a deadline on every call.
#[derive(Clone, Debug, Default)]
pub struct EveryCall {
    token: Option<MetadataValue<Ascii>>,
}

impl Interceptor for EveryCall {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(token) = &self.token {
            request.metadata_mut().insert("authorization", token.clone());
        }
        let deadline = request.extensions().get::<GrpcMethod<'static>>().and_then(deadline);
        // A caller in a hurry has set one already.
        if let Some(deadline) = deadline.filter(|_| !request.metadata().contains_key("grpc-timeout")) {
            request.set_timeout(deadline);
        }
        Ok(request)
    }
}

/// How long a call may take, for both sides. A stream lasts as long as it is wanted.
fn deadline(method: &GrpcMethod<'static>) -> Option<Duration> {
    match (method.service(), method.method()) {
        ("rit.v1.Rollout", "Join") | ("rit.v1.Episodes", "Send") | ("rit.v1.Control", "Metrics") => None,
        ("rit.v1.Control", "Evaluate" | "Checkpoint") => Some(LONG_CALL_TIMEOUT),
        _ => Some(CALL_TIMEOUT),
    }
}

/// Connects to a learner and makes sure that it listens to this caller.
///
/// # Errors
/// When no answer comes from there, either side does not trust the other, or what is sent could be overheard.
pub async fn connect(address: &Address, credentials: &Credentials) -> Result<Client, ConnectError> {
    let Credentials { token, tls } = credentials;
    if tls.is_none() && !address.is_local() {
        return Err(ConnectError::ClearText(address.clone()));
    }
    let uri = match address {
        Address::Unix(path) => format!("unix:{}", path.display()),
        // With TLS too: the connector sees to that.
        Address::Tcp { .. } => address.to_string().replacen("tcp:", "http://", 1),
    };
    let no_answer = |error: tonic::transport::Error| why(address, &error);
    let endpoint = Endpoint::try_from(uri)
        .map_err(no_answer)?
        .connect_timeout(CONNECT_TIMEOUT)
        .tcp_nodelay(true)
        .max_frame_size(FRAME_BYTES_MAX)
        .http2_keep_alive_interval(KEEPALIVE_EVERY)
        .keep_alive_timeout(KEEPALIVE_TIMEOUT)
        .keep_alive_while_idle(true);
    let channel = match (tls, address) {
        (Some(tls), Address::Tcp { host, port }) => {
            let (tls, host, port) = (tls.clone(), host.clone(), *port);
            let connector = service_fn(move |_| connect_tls(tls.clone(), host.clone(), port));
            endpoint.connect_with_connector(connector).await
        }
        _ => endpoint.connect().await,
    };
    let client = InterceptedService::new(channel.map_err(no_answer)?, EveryCall { token: token.clone() });
    let greeting = HealthClient::new(client.clone()).check(HealthCheckRequest::default()).await;
    match greeting {
        Ok(_) => Ok(client),
        Err(status) => Err(match status.code() {
            Code::Unauthenticated => ConnectError::Token(address.clone()),
            Code::ResourceExhausted => {
                ConnectError::Busy { address: address.clone(), reason: status.message().to_owned() }
            }
            _ => why(address, &status),
        }),
    }
}

/// A connection with TLS on which the learner has said its first word: HTTP/2's settings, which it sends unasked. With
/// TLS 1.3 a caller's handshake ends before the learner has seen its certificate; a refusal comes in place of the
/// settings, and would be lost if it ended a connection on which no call is under way.
async fn connect_tls(
    tls: TlsConnector,
    host: String,
    port: u16,
) -> io::Result<TokioIo<BufReader<TlsStream<TcpStream>>>> {
    let stream = TcpStream::connect((host.as_str(), port)).await?;
    stream.set_nodelay(true)?;
    let name = ServerName::try_from(host).map_err(io::Error::other)?;
    let mut stream = BufReader::new(tls.connect(name, stream).await?);
    if stream.fill_buf().await?.is_empty() {
        return Err(io::ErrorKind::UnexpectedEof.into());
    }
    Ok(TokioIo::new(stream))
}

/// What a failed connection comes down to.
fn why(address: &Address, error: &(dyn Error + 'static)) -> ConnectError {
    let address = address.clone();
    // The layers between rustls and here keep its words, not its types.
    let mut cause = Some(error);
    while let Some(error) = cause {
        let words = error.to_string();
        if let Some((_, alert)) = words.split_once("received fatal alert: ") {
            let reason = alert.chars().take_while(char::is_ascii_alphanumeric).collect();
            return ConnectError::Certificate { address, reason };
        }
        if let Some((_, reason)) = words.split_once("invalid peer certificate: ") {
            return ConnectError::Untrusted { address, reason: reason.to_owned() };
        }
        cause = error.source();
    }
    let reason = innermost(error);
    let reason = if words::is_of_a_library(&reason) { "the connection broke".to_owned() } else { reason };
    ConnectError::NoAnswer { address, reason }
}

/// The cause at the end of a chain of errors: what a person can act on.
fn innermost(error: &dyn Error) -> String {
    error.source().map_or_else(|| error.to_string(), innermost)
}
