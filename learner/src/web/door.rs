//! The door of a page: plain HTTP on a loopback address, for those that know a token. A run's own page and `rit serve` use
//! it.

use super::{
    api::ApiError,
    auth::{self, Gate},
};
use axum::{
    Extension, Router,
    extract::{DefaultBodyLimit, Request},
    http::{HeaderName, HeaderValue, header},
    middleware::{self, Next},
    response::{IntoResponse as _, Response},
    routing::get,
};
use hyper::server::conn::http1;
use hyper_util::{
    rt::{TokioIo, TokioTimer},
    service::TowerToHyperService,
};
use rit_proto::transport::{Guarded, PlaceLimits, Places, STRANGER_DEADLINE};
use std::{io, net::SocketAddr, sync::Arc, time::Duration};
use tokio::{net::TcpListener, task::JoinSet};

/// Connections at a time, and so requests at a time: of browsers that have shown the token, and of those that have not
/// yet, or only ask whether the process lives.
const PLACES: PlaceLimits = PlaceLimits { known: 32, strangers: 32, deadline: STRANGER_DEADLINE };

/// How long the head of a request may take, and a connection lie idle.
const HEAD_TIMEOUT: Duration = Duration::from_secs(10);

/// How long an answer may take: an evaluation asked for on a busy machine.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(120);

/// Largest body of a request: a few names of tasks.
const BODY_BYTES_MAX: usize = 4096;

/// How long accepting waits after the system refused, for want of file handles perhaps.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Sent with everything: nothing from elsewhere runs in the page, nothing frames it, nothing is kept.
const HEADERS: [(HeaderName, &str); 7] = [
    (
        header::CONTENT_SECURITY_POLICY,
        "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; object-src 'none'",
    ),
    (header::X_FRAME_OPTIONS, "DENY"),
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (header::REFERRER_POLICY, "no-referrer"),
    (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
    (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    (header::CACHE_CONTROL, "no-store"),
];

/// A listening socket for a page.
#[derive(Debug)]
pub struct Door {
    listener: TcpListener,
    address: SocketAddr,
}

impl Door {
    /// Listens; with port 0 the system chooses one.
    ///
    /// # Errors
    /// When the address is in use, or the system refuses.
    pub async fn bind(address: SocketAddr) -> io::Result<Self> {
        let listener = TcpListener::bind(address).await?;
        let address = listener.local_addr()?;
        Ok(Self { listener, address })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Serves until it is over, and all callers that were let in have been told.
    pub async fn serve(self, router: Router, over: impl Future<Output = ()>) {
        let mut connections = JoinSet::new();
        tokio::select! {
            () = self.accept(&router, &mut connections) => {}
            () = over => {}
        }
        while connections.join_next().await.is_some() {}
    }

    async fn accept(&self, router: &Router, connections: &mut JoinSet<()>) {
        let places = Places::new(PLACES);
        loop {
            while connections.try_join_next().is_some() {}
            let stream = match self.listener.accept().await {
                Ok((stream, _)) => stream,
                Err(error) => {
                    tracing::warn!(%error, "a connection to the web page failed");
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                    continue;
                }
            };
            let (place, leave) = places.stranger();
            // A caller that shows the token makes its connection's place a known one.
            let service = TowerToHyperService::new(router.clone().layer(Extension(place.clone())));
            let stream = Guarded::new(stream, place, leave);
            connections.spawn(async move {
                let mut server = http1::Builder::new();
                server.timer(TokioTimer::new()).header_read_timeout(HEAD_TIMEOUT);
                if let Err(error) = server.serve_connection(TokioIo::new(stream), service).await {
                    tracing::debug!(%error, "a connection to the web page broke");
                }
            });
        }
    }
}

/// These routes for callers that the gate lets in; `/` is the gate itself, `/healthz` needs no token.
pub fn guarded(gate: Gate, routes: Router) -> Router {
    let gate = Arc::new(gate);
    let guarded = routes
        .fallback(|| async { ApiError::NotFound })
        .layer(middleware::from_fn_with_state(Arc::clone(&gate), auth::only_with_token))
        .layer(DefaultBodyLimit::max(BODY_BYTES_MAX));
    open()
        .route("/", get(auth::enter).with_state(gate))
        .fallback_service(guarded)
        .layer(middleware::from_fn(within_time))
        .layer(middleware::from_fn(auth::only_to_loopback))
        .layer(middleware::map_response(with_headers))
}

/// What needs no token, for machines that watch over this one.
fn open() -> Router {
    Router::new().route("/healthz", get(|| async { "ok\n" }))
}

async fn within_time(request: Request, next: Next) -> Response {
    match tokio::time::timeout(ANSWER_TIMEOUT, next.run(request)).await {
        Ok(response) => response,
        Err(_) => ApiError::TooSlow.into_response(),
    }
}

async fn with_headers(mut response: Response) -> Response {
    let headers = response.headers_mut();
    for (name, value) in HEADERS {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}
