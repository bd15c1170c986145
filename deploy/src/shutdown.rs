//! When a process shall end in order: Ctrl-C, SIGTERM, or the end of whoever started it.

use tokio::{
    io::AsyncReadExt as _,
    signal::unix::{SignalKind, signal},
};

/// Resolves at the first of Ctrl-C, SIGTERM and, where `supervised`, the end of standard input: the
/// supervisor holds its other end, and the system closes it however the supervisor dies.
pub async fn requested(supervised: bool) {
    let terminated = async {
        match signal(SignalKind::terminate()) {
            Ok(mut terminate) => {
                terminate.recv().await;
            }
            // Without the handler the signal ends the process by itself.
            Err(_) => std::future::pending().await,
        }
    };
    let interrupted = async {
        if tokio::signal::ctrl_c().await.is_err() {
            std::future::pending::<()>().await;
        }
    };
    let abandoned = async {
        if !supervised {
            std::future::pending::<()>().await;
        }
        let (mut stdin, mut buffer) = (tokio::io::stdin(), [0; 64]);
        while stdin.read(&mut buffer).await.is_ok_and(|read| read > 0) {}
    };
    tokio::select! {
        () = terminated => tracing::info!("SIGTERM: ending"),
        () = interrupted => tracing::info!("interrupted: ending"),
        () = abandoned => tracing::info!("whoever started this process has gone: ending"),
    }
}
