//! When a process shall end in order: Ctrl-C, SIGTERM, a terminal that closes, or the end of the process that started
//! this one.

use std::fs;
use tokio::{
    io::AsyncReadExt as _,
    signal::unix::{SignalKind, signal},
};

/// Resolves at the first of Ctrl-C, SIGTERM, SIGHUP and, where `supervised`, the end of standard input: the supervisor
/// holds its other end, and the system closes it however the supervisor dies. A SIGHUP that is ignored, as `nohup`
/// starts its program, stays ignored.
pub async fn requested(supervised: bool) {
    let terminated = received(SignalKind::terminate());
    let hung_up = async {
        if ignores(SignalKind::hangup()) {
            std::future::pending::<()>().await;
        }
        received(SignalKind::hangup()).await;
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
        () = hung_up => tracing::info!("SIGHUP: ending"),
        () = interrupted => tracing::info!("interrupted: ending"),
        () = abandoned => tracing::info!("whoever started this process has gone: ending"),
    }
}

async fn received(kind: SignalKind) {
    match signal(kind) {
        Ok(mut signals) => {
            signals.recv().await;
        }
        // Without the handler the signal ends the process by itself.
        Err(_) => std::future::pending().await,
    }
}

/// Whether this process was started with the signal ignored.
fn ignores(kind: SignalKind) -> bool {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0);
    // Signals are counted from 1.
    mask >> (kind.as_raw_value() - 1) & 1 == 1
}
