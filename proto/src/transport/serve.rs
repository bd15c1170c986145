//! Serving, within limits.

use super::{
    Access, Incoming, KEEPALIVE_EVERY, KEEPALIVE_TIMEOUT, LONG_CALL_TIMEOUT, PlaceLimits, Places,
    STRANGER_DEADLINE,
};
use tokio::sync::{mpsc, oneshot};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{
    service::{InterceptorLayer, Routes},
    transport::Server,
};
use tower::limit::GlobalConcurrencyLimitLayer;

/// Connections one address holds open at most: far more than a run has actors.
pub const CONNECTIONS_MAX: usize = 512;

/// Connections beside them of callers that have not shown yet that they may speak.
const STRANGERS_MAX: usize = 64;

/// Largest request a service takes that does not say otherwise: all of them are small.
pub const REQUEST_BYTES_MAX: usize = 64 << 10;

/// Streams one connection may have open. An actor has four.
const STREAMS_PER_CONNECTION_MAX: u32 = 64;

/// Calls of all connections that may wait for their answers at a time.
const CALLS_MAX: usize = 1024;

/// Bytes of all headers of a call.
const HEADER_BYTES_MAX: u32 = 16 << 10;

/// How much of everything a server takes on.
#[derive(Clone, Copy, Debug)]
pub struct ServeLimits {
    /// Connections that may be open at a time, and strangers' beside them.
    pub connections: PlaceLimits,
    /// Calls of all connections that may wait for their answers at a time.
    pub calls: usize,
}

impl Default for ServeLimits {
    fn default() -> Self {
        let connections =
            PlaceLimits { known: CONNECTIONS_MAX, strangers: STRANGERS_MAX, deadline: STRANGER_DEADLINE };
        Self { connections, calls: CALLS_MAX }
    }
}

/// Serves the callers that `access` lets in, until `closed` resolves and the last connection has ended.
///
/// # Errors
/// When the server fails.
pub async fn serve(
    incoming: Incoming,
    access: Access,
    limits: ServeLimits,
    routes: Routes,
    closed: impl Future<Output = ()>,
) -> Result<(), tonic::transport::Error> {
    let guard = InterceptorLayer::new(access.guard());
    let places = Places::new(limits.connections);
    let (connections, accepted) = mpsc::channel(1);
    let (stop, stopped) = oneshot::channel::<()>();
    let accepting = async move {
        tokio::select! {
            never = incoming.accept(&access, &places, &connections) => match never {},
            () = closed => {}
        }
        // Connections are no longer accepted; the socket goes now, not when the last connection has ended.
        drop((incoming, stop));
    };
    let serving = Server::builder()
        .timeout(LONG_CALL_TIMEOUT)
        .http2_keepalive_interval(Some(KEEPALIVE_EVERY))
        .http2_keepalive_timeout(Some(KEEPALIVE_TIMEOUT))
        .http2_max_header_list_size(HEADER_BYTES_MAX)
        .max_concurrent_streams(STREAMS_PER_CONNECTION_MAX)
        .concurrency_limit_per_connection(STREAMS_PER_CONNECTION_MAX as usize)
        // Who comes when all is taken is told so, rather than left waiting.
        .load_shed(true)
        .layer(guard)
        .layer(GlobalConcurrencyLimitLayer::new(limits.calls))
        .add_routes(routes)
        .serve_with_incoming_shutdown(ReceiverStream::new(accepted), async {
            let _ = stopped.await;
        });
    let ((), served) = tokio::join!(accepting, serving);
    served
}
