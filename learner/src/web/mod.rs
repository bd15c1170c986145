//! The page that shows a run and steers it, served to this machine's own browsers: plain HTTP on a loopback
//! address, for those that know the run's token.
//!
//! `auth` decides who gets in, `api` answers, `events` says what is new; `assets/` is the page itself. It
//! speaks to the run by a [`RunHandle`] as gRPC callers do, so nothing here can change what is trained.

mod api;
mod auth;
mod door;
mod events;

pub use auth::{Gate, Home};
pub use door::{Door, guarded};

use crate::{metrics::Follower, run_handle::RunHandle};
use axum::{Router, http::header, routing::get};
use rit_config::{RunDir, WebListen, write_whole};
use std::{
    fs,
    io::{self, ErrorKind},
    net::SocketAddr,
    path::PathBuf,
    sync::Arc,
    time::{SystemTime, UNIX_EPOCH},
};

/// Why the page cannot be served.
#[derive(Debug, thiserror::Error)]
pub enum WebError {
    /// Another process listens there.
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
    door: Door,
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
        let door = match Door::bind(address).await {
            // A run that goes on does not end for want of its page's port.
            Err(error) if before.is_some() => {
                tracing::warn!(%address, %error, "the web page moves to another port");
                Door::bind(any_port).await
            }
            bound => bound,
        };
        let door = door.map_err(|error| match error.kind() {
            ErrorKind::AddrInUse => WebError::InUse(address),
            _ => WebError::Listen { address, error },
        })?;
        let path = run_dir.web();
        write_url(run_dir, door.address()).map_err(|error| WebError::Io { path, error })?;
        Ok(Some(Self { door }))
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.door.address()
    }

    /// Serves until the run is over and all pages have been told.
    pub async fn serve(self, handle: RunHandle, metrics: Follower, run_dir: RunDir) {
        let learner = milliseconds();
        let gate = Gate::of_run(&run_dir);
        let page = Page { handle: handle.clone(), metrics, run_dir: Arc::new(run_dir), learner };
        let routes = api::router().merge(assets()).with_state(page);
        self.door.serve(guarded(gate, routes), handle.over()).await;
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
