//! When a process shall shut down gracefully: Ctrl-C, SIGTERM, a terminal that closes, or the end of the process that started
//! this one.

use std::{fs, pin::Pin};
use tokio::{
    io::AsyncReadExt as _,
    signal::unix::{Signal, SignalKind, signal},
};

/// Resolves at the first request of [`Requests`].
pub fn requested(supervised: bool) -> impl Future<Output = ()> {
    let mut requests = Requests::new(supervised);
    async move { requests.next().await }
}

/// Ctrl-C, SIGTERM, SIGHUP and, where `supervised`, the end of standard input: the supervisor holds its other end, and the
/// system closes it however the supervisor dies. A SIGHUP that is ignored, as `nohup` starts its program, stays ignored.
pub struct Requests {
    terminated: Option<Signal>,
    interrupted: Option<Signal>,
    hung_up: Option<Signal>,
    abandoned: Pin<Box<dyn Future<Output = ()> + Send>>,
    /// One has come.
    came: bool,
}

impl Requests {
    /// Signals are caught from this call on, however late they are waited for.
    pub fn new(supervised: bool) -> Self {
        let abandoned = async move {
            if !supervised {
                std::future::pending::<()>().await;
            }
            let (mut stdin, mut buffer) = (tokio::io::stdin(), [0; 64]);
            while stdin.read(&mut buffer).await.is_ok_and(|read| read > 0) {}
        };
        Self {
            terminated: caught(SignalKind::terminate()),
            interrupted: caught(SignalKind::interrupt()),
            hung_up: if ignores(SignalKind::hangup()) { None } else { caught(SignalKind::hangup()) },
            abandoned: Box::pin(abandoned),
            came: false,
        }
    }

    /// The next request. Only Ctrl-C and SIGTERM make one after the first: a terminal that closes may send SIGHUP more than
    /// once, and asks for no more than an end. Where this is dropped, no request is lost.
    pub async fn next(&mut self) {
        tokio::select! {
            () = next(&mut self.terminated) => tracing::info!("SIGTERM: ending"),
            () = next(&mut self.interrupted) => tracing::info!("interrupted: ending"),
            () = next(&mut self.hung_up), if !self.came => tracing::info!("SIGHUP: ending"),
            () = &mut self.abandoned, if !self.came => {
                tracing::info!("the process that started this one has gone: ending");
            }
        }
        self.came = true;
    }
}

/// Where SIGHUP is ignored, as under `nohup`, all that this process starts would ignore it too. A process that catches a
/// signal hands its default action down; this one goes on when it comes.
pub fn hand_hangups_down() {
    if ignores(SignalKind::hangup()) {
        drop(caught(SignalKind::hangup()));
    }
}

/// Catches a signal. One that cannot be caught keeps its default: it ends the process.
fn caught(kind: SignalKind) -> Option<Signal> {
    signal(kind).ok()
}

async fn next(signals: &mut Option<Signal>) {
    match signals {
        Some(signals) => drop(signals.recv().await),
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
