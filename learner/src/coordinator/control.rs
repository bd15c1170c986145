//! What callers want of a run.

use super::Coordinator;
use crate::trainer::{Checkpointed, Work};
use rit_config::Config;
use rit_proto::v1;
use std::sync::Arc;
use tokio::sync::oneshot;

/// What callers want, each with the way to answer.
#[derive(Debug)]
pub enum Control {
    /// How the run stands.
    Status(oneshot::Sender<v1::RunStatus>),
    /// No further lease.
    Pause(oneshot::Sender<v1::RunStatus>),
    /// Leases again.
    Resume(oneshot::Sender<v1::RunStatus>),
    /// A checkpoint.
    Checkpoint(oneshot::Sender<Checkpointed>),
    /// The end of the run, with what is under way (`drain`) or without.
    Stop {
        /// Whether episodes under way are waited for.
        drain: bool,
        /// The way to answer.
        answer: oneshot::Sender<v1::RunStatus>,
    },
    /// Other settings from now on.
    Set(Arc<Config>, oneshot::Sender<v1::RunStatus>),
}

impl Coordinator {
    pub(super) fn control(&mut self, control: Control) {
        // Whoever asked may have gone; the answers are then nobody's.
        match control {
            Control::Status(answer) => {
                let _ = answer.send(self.status());
            }
            Control::Pause(answer) => {
                if self.state == v1::RunState::Running {
                    self.state = v1::RunState::Paused;
                    tracing::info!("paused");
                    self.happened("paused".into());
                }
                let _ = answer.send(self.status());
            }
            Control::Resume(answer) => {
                if self.state == v1::RunState::Paused {
                    self.state = v1::RunState::Running;
                    tracing::info!("resumed");
                    self.happened("resumed".into());
                    self.hand_out();
                }
                let _ = answer.send(self.status());
            }
            Control::Checkpoint(answer) => {
                let _ = self.work.send(Work::Checkpoint(answer));
            }
            Control::Stop { drain, answer } => {
                tracing::info!(drain, "asked to stop");
                self.happened("asked to stop".into());
                self.state = v1::RunState::Stopping;
                self.draining = drain;
                if drain {
                    self.stop_if_drained();
                } else {
                    let _ = self.work.send(Work::Stop);
                }
                let _ = answer.send(self.status());
            }
            Control::Set(config, answer) => {
                self.config = Config::clone(&config);
                let _ = self.work.send(Work::Set(config));
                self.happened("settings changed".into());
                let _ = answer.send(self.status());
            }
        }
    }

    /// Ends the run once nothing is under way any more; batches that are full are trained on first.
    pub(super) fn stop_if_drained(&mut self) {
        if self.draining && self.ledger.counts().outstanding == 0 {
            self.draining = false;
            let _ = self.work.send(Work::Stop);
        }
    }
}
