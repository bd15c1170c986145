//! Where a learner listens, and its servers.

use super::LearnerError;
use crate::{metrics::Follower, run_handle::RunHandle, web::Web};
use rit_config::{Config, RunDir, Tls, write_whole};
use rit_proto::transport::{Access, AccessFiles, Address, Incoming, ServeLimits, serve};
use std::{fs, path::PathBuf, time::Duration};
use tokio::{sync::watch, task::JoinSet};
use tonic::service::Routes;

/// How long the end of a run waits for connections to close.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(1);

/// Where the learner listens and what callers must show.
pub(super) struct Doors {
    /// The run directory's socket, and TCP if it is asked for.
    grpc: Vec<(Incoming, Access)>,
    web: Option<Web>,
}

impl Doors {
    /// Listens everywhere; calls wait until they are served.
    ///
    /// # Errors
    /// When an address is in use or would let in whom it should not, or the system refuses.
    pub(super) async fn open(run_dir: &RunDir, config: &Config) -> Result<Self, LearnerError> {
        let socket = Incoming::bind(&Address::Unix(run_dir.socket())).await?;
        let mut grpc = vec![(socket, Access::token(run_dir.token()))];
        if config.learner.listen != "unix" {
            let address: Address = config.learner.listen.parse()?;
            let file = |path: &String| (!path.is_empty()).then(|| PathBuf::from(path));
            let Tls { certificate, key, client_ca } = &config.learner.tls;
            let files = AccessFiles {
                token: file(&config.learner.token_file),
                certificate: file(certificate),
                key: file(key),
                client_ca: file(client_ca),
            };
            let access = Access::over_tcp(&address, &files)?;
            grpc.push((Incoming::bind(&address).await?, access));
        }
        let web = Web::bind(run_dir, config.web.listen).await?;
        Ok(Self { grpc, web })
    }

    /// Serves at every one, and tells readers of the run directory where.
    ///
    /// # Errors
    /// When the address cannot be written down.
    pub(super) fn serve(
        self,
        run_dir: &RunDir,
        routes: &Routes,
        handle: RunHandle,
        metrics: Follower,
    ) -> Result<Serving, LearnerError> {
        let mut serving_web = JoinSet::new();
        if let Some(web) = self.web {
            tracing::info!(address = %web.address(), "the web page is served");
            serving_web.spawn(web.serve(handle, metrics, run_dir.clone()));
        }
        // What a learner that was killed has left; this one may not listen for other hosts.
        let _ = fs::remove_file(run_dir.remote_address());
        let (close, closed) = watch::channel(());
        let mut servers = JoinSet::new();
        for (incoming, access) in self.grpc {
            tell_address(run_dir, incoming.address())?;
            tracing::info!(address = %incoming.address(), ?access, "the learner listens");
            let mut closed = closed.clone();
            let closed = async move {
                // Never a value: it changes by its end.
                let _ = closed.changed().await;
            };
            servers.spawn(serve(incoming, access, ServeLimits::default(), routes.clone(), closed));
        }
        Ok(Serving { close, servers, web: serving_web })
    }
}

/// The servers.
pub(super) struct Serving {
    /// Dropped, it ends those of gRPC.
    close: watch::Sender<()>,
    servers: JoinSet<Result<(), tonic::transport::Error>>,
    /// Ends when the coordinator has gone.
    web: JoinSet<()>,
}

impl Serving {
    /// Waits for servers to close their connections. Those that are open even after [`CLOSE_TIMEOUT`] have had their time.
    pub(super) async fn end(self) {
        let Self { close, mut servers, mut web } = self;
        drop(close);
        let closing = async {
            while let Some(served) = servers.join_next().await {
                if let Ok(Err(error)) = served {
                    tracing::error!(%error, "a gRPC server failed");
                }
            }
        };
        let _ = tokio::time::timeout(CLOSE_TIMEOUT, closing).await;
        let _ = tokio::time::timeout(CLOSE_TIMEOUT, web.join_next()).await;
    }
}

/// Tells readers of the run directory where the learner listens: renamed into place, so it is whole.
fn tell_address(run_dir: &RunDir, address: &Address) -> Result<(), LearnerError> {
    let path = match address {
        Address::Unix(_) => run_dir.address(),
        Address::Tcp { .. } => run_dir.remote_address(),
    };
    let written = write_whole(&path, format!("{address}\n").as_bytes());
    written.map_err(|error| LearnerError::Io { what: path.display().to_string(), error })
}
