//! The page that shows a run and steers it, served to this machine's own browsers: plain HTTP on a loopback
//! address, for whoever knows the run's token.
//!
//! `auth` decides who gets in, `api` answers, `events` says what is new; `assets/` is the page itself. It
//! speaks to the run by a [`RunHandle`] as gRPC callers do, so nothing here can change what is trained.

mod api;
mod auth;
mod events;

use crate::{metrics::Follower, run_handle::RunHandle};
use auth::Gate;
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
use rit_config::{RunDir, WebListen, write_whole};
use rit_proto::transport::{Guarded, PlaceLimits, Places, STRANGER_DEADLINE};
use std::{
    fs,
    io::{self, ErrorKind},
    net::SocketAddr,
    path::PathBuf,
    sync::Arc,
    time::{Duration, SystemTime, UNIX_EPOCH},
};
use tokio::{net::TcpListener, task::JoinSet};

/// Connections at a time, and so requests at a time: of browsers that have shown the token, and of those that have not
/// yet, or only ask whether the learner lives.
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

/// Why the page cannot be served.
#[derive(Debug, thiserror::Error)]
pub enum WebError {
    /// Somebody listens there.
    #[error("web.listen = \"{0}\" is in use; write another port, or 127.0.0.1:0 for one that is free")]
    InUse(SocketAddr),
    /// The system refused.
    #[error("web.listen = \"{address}\": {error}")]
    Listen {
        /// Where.
        address: SocketAddr,
        /// Why.
        error: io::Error,
    },
    /// Its address cannot be written down.
    #[error("{path}: {error}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
}

/// A listening socket for the page.
#[derive(Debug)]
pub struct Web {
    listener: TcpListener,
    address: SocketAddr,
}

impl Web {
    /// Listens, and writes the page's address into the run directory. Where a learner of this run has listened
    /// before, its port is taken again, so that an open page finds the new learner.
    ///
    /// # Errors
    /// When a new run's address is in use, or the system refuses.
    pub async fn bind(run_dir: &RunDir, listen: WebListen) -> Result<Option<Self>, WebError> {
        let WebListen::On(wanted) = listen else {
            // What an earlier learner has left; most often there is nothing.
            let _ = fs::remove_file(run_dir.web());
            return Ok(None);
        };
        let before = last_port(run_dir);
        let address = match (wanted.port(), before) {
            (0, Some(port)) => SocketAddr::new(wanted.ip(), port),
            _ => wanted,
        };
        let any_port = SocketAddr::new(wanted.ip(), 0);
        let listener = match TcpListener::bind(address).await {
            // A run that goes on does not end for want of its page's port.
            Err(error) if before.is_some() => {
                tracing::warn!(%address, %error, "the web page moves to another port");
                TcpListener::bind(any_port).await
            }
            bound => bound,
        };
        let listener = listener.map_err(|error| match error.kind() {
            ErrorKind::AddrInUse => WebError::InUse(address),
            _ => WebError::Listen { address, error },
        })?;
        let address = listener.local_addr().map_err(|error| WebError::Listen { address, error })?;
        let path = run_dir.web();
        write_url(run_dir, address).map_err(|error| WebError::Io { path, error })?;
        Ok(Some(Self { listener, address }))
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Serves until the run is over and everybody has been told.
    pub async fn serve(self, handle: RunHandle, metrics: Follower, run_dir: RunDir) {
        let mut connections = JoinSet::new();
        let learner = milliseconds();
        let router = router(Page { handle: handle.clone(), metrics, run_dir: Arc::new(run_dir), learner });
        tokio::select! {
            () = self.accept(&router, &mut connections) => {}
            () = handle.over() => {}
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
            // Whoever shows the token makes its connection's place a known one.
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

/// What every answer is made from.
#[derive(Clone)]
struct Page {
    handle: RunHandle,
    /// At the first line of what has been measured.
    metrics: Follower,
    run_dir: Arc<RunDir>,
    /// Tells this learner from those before it on the same run.
    learner: u64,
}

fn router(page: Page) -> Router {
    let gate = Arc::new(Gate::new(&page.run_dir));
    let guarded = api::router()
        .merge(assets())
        .fallback(|| async { api::ApiError::NotFound })
        .layer(middleware::from_fn_with_state(Arc::clone(&gate), auth::only_with_token))
        .layer(DefaultBodyLimit::max(BODY_BYTES_MAX));
    open()
        .route("/", get(auth::enter).with_state(gate))
        .fallback_service(guarded.with_state(page))
        .layer(middleware::from_fn(within_time))
        .layer(middleware::from_fn(auth::only_to_loopback))
        .layer(middleware::map_response(with_headers))
}

/// What needs no token, for machines that watch over this one.
fn open() -> Router {
    Router::new().route("/healthz", get(|| async { "ok\n" }))
}

/// The page itself, part of the program.
fn assets<S: Clone + Send + Sync + 'static>() -> Router<S> {
    const CSS: &str = "text/css; charset=utf-8";
    const JS: &str = "text/javascript; charset=utf-8";
    let files = [
        ("/style.css", CSS, include_str!("assets/style.css")),
        ("/main.js", JS, include_str!("assets/main.js")),
        ("/feed.js", JS, include_str!("assets/feed.js")),
        ("/chart.js", JS, include_str!("assets/chart.js")),
        ("/panels.js", JS, include_str!("assets/panels.js")),
        ("/episode.js", JS, include_str!("assets/episode.js")),
        ("/text.js", JS, include_str!("assets/text.js")),
        ("/icon.svg", "image/svg+xml", include_str!("assets/icon.svg")),
    ];
    files.into_iter().fold(Router::new(), |router, (path, kind, text)| {
        router.route(path, get(move || async move { ([(header::CONTENT_TYPE, kind)], text) }))
    })
}

async fn within_time(request: Request, next: Next) -> Response {
    match tokio::time::timeout(ANSWER_TIMEOUT, next.run(request)).await {
        Ok(response) => response,
        Err(_) => api::ApiError::TooSlow.into_response(),
    }
}

async fn with_headers(mut response: Response) -> Response {
    let headers = response.headers_mut();
    for (name, value) in HEADERS {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

/// The page's address for a person: it carries the token.
fn write_url(run_dir: &RunDir, address: SocketAddr) -> io::Result<()> {
    let (path, url) = (run_dir.web(), format!("http://{address}/?token={}\n", run_dir.token()));
    write_whole(&path, url.as_bytes())
}

/// The port that a learner of this run had before.
fn last_port(run_dir: &RunDir) -> Option<u16> {
    let url = run_dir.web_url()?;
    let (address, _) = url.strip_prefix("http://")?.split_once('/')?;
    address.parse::<SocketAddr>().ok().map(|address| address.port())
}

/// Milliseconds since 1970: no result follows from them.
fn milliseconds() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as u64)
}
