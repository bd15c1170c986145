//! When a process shall shut down gracefully: Ctrl-C, SIGTERM, a terminal that closes, or the end of the process that started
//! this one.

use std::fs;
use tokio::{
    io::AsyncReadExt as _,
    signal::unix::{Signal, SignalKind, signal},
};

/// Resolves at the first of Ctrl-C, SIGTERM, SIGHUP and, where `supervised`, the end of standard input: the supervisor
/// holds its other end, and the system closes it however the supervisor dies. A SIGHUP that is ignored, as `nohup`
/// starts its program, stays ignored.
///
/// Signals are caught from this call on, though the future be waited for much later.
pub fn requested(supervised: bool) -> impl Future<Output = ()> {
    let terminated = caught(SignalKind::terminate());
    let interrupted = caught(SignalKind::interrupt());
    let hung_up = if ignores(SignalKind::hangup()) { None } else { caught(SignalKind::hangup()) };
    let abandoned = async move {
        if !supervised {
            std::future::pending::<()>().await;
        }
        let (mut stdin, mut buffer) = (tokio::io::stdin(), [0; 64]);
        while stdin.read(&mut buffer).await.is_ok_and(|read| read > 0) {}
    };
    async move {
        tokio::select! {
            () = next(terminated) => tracing::info!("SIGTERM: ending"),
            () = next(interrupted) => tracing::info!("interrupted: ending"),
            () = next(hung_up) => tracing::info!("SIGHUP: ending"),
            () = abandoned => tracing::info!("the process that started this one has gone: ending"),
        }
    }
}

/// Where SIGHUP is ignored, as under `nohup`, all that this process starts would ignore it too. A process that catches a
/// signal hands its default action down; this one goes on when it comes.
pub fn hand_hangups_down() {
    if ignores(SignalKind::hangup()) {
        drop(caught(SignalKind::hangup()));
    }
}

/// Catches a signal; where that does not go, it ends the process by itself.
fn caught(kind: SignalKind) -> Option<Signal> {
    signal(kind).ok()
}

async fn next(signals: Option<Signal>) {
    match signals {
        Some(mut signals) => drop(signals.recv().await),
        None => std::future::pending().await,
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
