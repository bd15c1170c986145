//! What callers must show before a learner listens to them.

use super::{
    ALPN_HTTP2, Address, Place,
    files::{FileError, read_authorities, read_certificates, read_key, read_token},
};
use std::{fmt, path::PathBuf, sync::Arc};
use tokio_rustls::{
    TlsAcceptor,
    rustls::{
        self, ServerConfig,
        crypto::ring,
        server::{VerifierBuilderError, WebPkiClientVerifier},
        version::TLS13,
    },
};
use tonic::{Request, Status, service::Interceptor};

/// The files that say who may call over TCP.
#[derive(Clone, Debug, Default)]
pub struct AccessFiles {
    /// A token that every call must carry.
    pub token: Option<PathBuf>,
    /// The learner's certificate.
    pub certificate: Option<PathBuf>,
    /// Its key.
    pub key: Option<PathBuf>,
    /// Callers must have a certificate of this authority.
    pub client_ca: Option<PathBuf>,
}

/// Why a learner does not listen: callers would be let in that should not be.
#[derive(Debug, thiserror::Error)]
pub enum AccessError {
    /// Nothing is demanded.
    #[error(
        "learner.listen = {0}: anybody could call; set learner.tls.certificate, learner.tls.key and \
         learner.tls.client_ca (`rit certificates` makes them), or learner.token_file"
    )]
    Open(Address),
    /// A token would be readable on its way.
    #[error(
        "learner.listen = {0}: the token would cross a network in clear text; set learner.tls.certificate and \
         learner.tls.key too (`rit certificates` makes them), or listen on tcp:127.0.0.1:PORT"
    )]
    ClearText(Address),
    /// Part of what TLS takes.
    #[error("learner.tls.{0} is not set; TLS takes learner.tls.certificate and learner.tls.key together")]
    Incomplete(&'static str),
    /// A file cannot be used.
    #[error(transparent)]
    File(#[from] FileError),
    /// Key and certificate do not belong together, or cannot be used.
    #[error("learner.tls: {0}")]
    Tls(#[from] rustls::Error),
    /// The client authority's certificates cannot be used.
    #[error("learner.tls.client_ca: {0}")]
    ClientAuthority(#[from] VerifierBuilderError),
}

/// What callers must show.
#[derive(Clone)]
pub struct Access {
    token: Option<String>,
    pub(super) tls: Option<TlsAcceptor>,
}

impl fmt::Debug for Access {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Never the token.
        f.debug_struct("Access")
            .field("token", &self.token.is_some())
            .field("tls", &self.tls.is_some())
            .finish()
    }
}

impl Access {
    /// This token, over a link that others cannot listen in on.
    pub fn token(token: &str) -> Self {
        Self { token: Some(token.to_owned()), tls: None }
    }

    /// What these files say, for a TCP address.
    ///
    /// # Errors
    /// When that would let every caller in, or a file cannot be used.
    pub fn over_tcp(address: &Address, files: &AccessFiles) -> Result<Self, AccessError> {
        let AccessFiles { token, certificate, key, client_ca } = files;
        let identity = match (certificate, key) {
            (Some(certificate), Some(key)) => Some((certificate, key)),
            (Some(_), None) => return Err(AccessError::Incomplete("key")),
            (None, Some(_)) => return Err(AccessError::Incomplete("certificate")),
            (None, None) if client_ca.is_some() => return Err(AccessError::Incomplete("certificate")),
            (None, None) => None,
        };
        if token.is_none() && client_ca.is_none() {
            return Err(AccessError::Open(address.clone()));
        }
        if identity.is_none() && !address.is_local() {
            return Err(AccessError::ClearText(address.clone()));
        }
        let token = token.as_deref().map(read_token).transpose()?;
        let Some((certificate, key)) = identity else { return Ok(Self { token, tls: None }) };
        let provider = Arc::new(ring::default_provider());
        // Both ends are this program: nothing older is ever needed.
        let config =
            ServerConfig::builder_with_provider(Arc::clone(&provider)).with_protocol_versions(&[&TLS13])?;
        let config = match client_ca {
            Some(path) => {
                let authorities = Arc::new(read_authorities(path)?);
                let verifier = WebPkiClientVerifier::builder_with_provider(authorities, provider).build()?;
                config.with_client_cert_verifier(verifier)
            }
            None => config.with_no_client_auth(),
        };
        let mut config = config.with_single_cert(read_certificates(certificate)?, read_key(key)?)?;
        config.alpn_protocols = vec![ALPN_HTTP2.to_vec()];
        Ok(Self { token, tls: Some(TlsAcceptor::from(Arc::new(config))) })
    }

    /// Whether a certificate is all that callers must show.
    pub(super) fn by_certificate(&self) -> bool {
        self.token.is_none()
    }

    /// Lets only calls through that carry the token, if there is one.
    pub(super) fn guard(&self) -> Guard {
        Guard(self.token.as_ref().map(|token| format!("Bearer {token}").into()))
    }
}

/// Whether what was given is the secret. Looks at every byte, even where the first ones differ.
pub fn is_secret(given: &[u8], secret: &[u8]) -> bool {
    given.iter().zip(secret).fold(given.len() ^ secret.len(), |all, (a, b)| all | usize::from(a ^ b)) == 0
}

/// Lets only calls through that carry the token; who makes one is known from then on.
#[derive(Clone)]
pub(super) struct Guard(Option<Arc<str>>);

impl Interceptor for Guard {
    fn call(&mut self, request: Request<()>) -> Result<Request<()>, Status> {
        let Some(known) = &self.0 else { return Ok(request) };
        let given = request.metadata().get("authorization").map_or(&[][..], |value| value.as_bytes());
        if !is_secret(given, known.as_bytes()) {
            return Err(Status::unauthenticated("the call does not carry this learner's token"));
        }
        if let Some(place) = request.extensions().get::<Place>() {
            place.make_known().map_err(|all_taken| Status::resource_exhausted(all_taken.to_string()))?;
        }
        Ok(request)
    }
}
