//! What people want of a run: pause, resume, stop, other settings.

use super::{Coordinator, Effect, State};
use rit_config::Config;
use rit_record::Ended;
use std::sync::Arc;

impl Coordinator {
    pub(super) fn pause(&mut self) {
        if self.state == State::Running {
            self.state = State::Paused;
            self.stands_still = None;
            tracing::info!("paused");
            self.happened("paused".into());
        }
    }

    pub(super) fn resume(&mut self, effects: &mut Vec<Effect>) {
        if self.state == State::Paused {
            self.state = State::Running;
            self.moved_at = self.now;
            tracing::info!("resumed");
            self.happened("resumed".into());
            self.hand_out(effects);
        }
    }

    pub(super) fn stop(&mut self, drain: bool, ended: Ended, effects: &mut Vec<Effect>) {
        tracing::info!(drain, "asked to stop");
        self.happened("asked to stop".into());
        self.state = State::Stopping;
        self.draining = drain.then_some(ended);
        if !drain {
            effects.push(Effect::EndTraining(ended));
        }
    }

    pub(super) fn set(&mut self, config: Arc<Config>, effects: &mut Vec<Effect>) {
        self.config = Config::clone(&config);
        effects.push(Effect::Configure(config));
        self.happened("settings changed".into());
    }

    /// Ends the run once nothing is under way any more; batches that are full are trained on first.
    pub(super) fn stop_if_drained(&mut self, effects: &mut Vec<Effect>) {
        if self.ledger.counts().outstanding == 0
            && let Some(ended) = self.draining.take()
        {
            effects.push(Effect::EndTraining(ended));
        }
    }
}
