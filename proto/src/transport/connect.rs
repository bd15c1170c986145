//! Connecting to a learner.

use super::{
    Address, CALL_TIMEOUT, CONNECT_TIMEOUT, KEEPALIVE_EVERY, KEEPALIVE_TIMEOUT, LONG_CALL_TIMEOUT,
    files::{FileError, read_authorities, read_certificates, read_key, read_token},
};
use std::{error::Error, fmt, path::PathBuf, time::Duration};
use tonic::{
    Code, GrpcMethod, Request, Status,
    metadata::{Ascii, MetadataValue},
    service::{Interceptor, interceptor::InterceptedService},
    transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity},
};
use tonic_health::pb::{HealthCheckRequest, health_client::HealthClient};

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
}

/// What a caller shows.
#[derive(Clone, Default)]
pub struct Credentials {
    token: Option<MetadataValue<Ascii>>,
    tls: Option<ClientTlsConfig>,
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
            (Some(certificate), Some(key)) => {
                Some(Identity::from_pem(read_certificates(certificate)?.0, read_key(key)?.0))
            }
            (None, None) => None,
            (Some(_), None) => return Err(CredentialsError::Incomplete("key")),
            (None, Some(_)) => return Err(CredentialsError::Incomplete("certificate")),
        };
        let tls = match ca {
            Some(ca) => {
                let config =
                    ClientTlsConfig::new().ca_certificate(Certificate::from_pem(read_authorities(ca)?.0));
                Some(match identity {
                    Some(identity) => config.identity(identity),
                    None => config,
                })
            }
            None if identity.is_some() => return Err(CredentialsError::Incomplete("ca")),
            None => None,
        };
        Ok(Self { tls, ..token.map_or_else(Self::default, |token| Self::token(&token)) })
    }
}

/// Why a learner cannot be spoken to.
#[derive(Debug, thiserror::Error)]
pub enum ConnectError {
    /// Nobody answers there, or closes the connection.
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
    /// Whoever answers has no certificate of the authority given.
    #[error(
        "whoever answers on {address} does not prove to be the learner ({reason}); is --tls-ca its authority?"
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
        ("rit.v1.Rollout", "Join")
        | ("rit.v1.Weights", "Watch")
        | ("rit.v1.Episodes", "Send")
        | ("rit.v1.Control", "Metrics") => None,
        ("rit.v1.Control", "Evaluate" | "Checkpoint") => Some(LONG_CALL_TIMEOUT),
        _ => Some(CALL_TIMEOUT),
    }
}

/// Connects to a learner and makes sure that it listens to this caller.
///
/// # Errors
/// When nobody answers there, either side does not trust the other, or what is sent could be overheard.
pub async fn connect(address: &Address, credentials: &Credentials) -> Result<Client, ConnectError> {
    let Credentials { token, tls } = credentials;
    if tls.is_none() && !address.is_local() {
        return Err(ConnectError::ClearText(address.clone()));
    }
    let uri = match address {
        Address::Unix(path) => format!("unix:{}", path.display()),
        Address::Tcp { .. } => {
            let scheme = if tls.is_some() { "https" } else { "http" };
            address.to_string().replacen("tcp:", &format!("{scheme}://"), 1)
        }
    };
    let no_answer = |error: tonic::transport::Error| why(address, &error);
    let mut endpoint = Endpoint::try_from(uri)
        .map_err(no_answer)?
        .connect_timeout(CONNECT_TIMEOUT)
        .tcp_nodelay(true)
        .http2_keep_alive_interval(KEEPALIVE_EVERY)
        .keep_alive_timeout(KEEPALIVE_TIMEOUT)
        .keep_alive_while_idle(true);
    if let (Some(tls), Address::Tcp { host, .. }) = (tls, address) {
        endpoint = endpoint.tls_config(tls.clone().domain_name(host)).map_err(no_answer)?;
    }
    let mut attempts = if tls.is_some() { TLS_ATTEMPTS } else { 1 };
    loop {
        attempts -= 1;
        match greet(address, &endpoint, token.as_ref()).await {
            Err(ConnectError::NoAnswer { reason, .. }) if reason == REASON_LOST && attempts > 0 => {}
            outcome => return outcome,
        }
    }
}

/// How often a connection is made at most whose end does not say why.
const TLS_ATTEMPTS: usize = 20;

/// What hyper says of a call on a connection that failed just before: the connection's own error, which has the
/// reason, is nowhere to be had then.
const REASON_LOST: &str = "connection closed";

/// Connects, and makes a first call. With TLS 1.3 a learner refuses a certificate after the handshake, as far as the
/// caller can tell: the refusal meets the call, or comes just before it, and then its reason is lost.
async fn greet(
    address: &Address,
    endpoint: &Endpoint,
    token: Option<&MetadataValue<Ascii>>,
) -> Result<Client, ConnectError> {
    let channel = endpoint.connect().await.map_err(|error| why(address, &error))?;
    let client = InterceptedService::new(channel, EveryCall { token: token.cloned() });
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
    ConnectError::NoAnswer { address, reason: innermost(error) }
}

/// The cause at the end of a chain of errors: what a person can act on.
fn innermost(error: &dyn Error) -> String {
    error.source().map_or_else(|| error.to_string(), innermost)
}
