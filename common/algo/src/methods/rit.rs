//! RIT and its ablations under training.

use crate::{
    Learner, Losses, Model, Rit, Update, UpdateConfig, contrastive,
    learner::{Draw, Measure, NamedState, NotFinite, Place, StateError, restore},
};
use rayon::ThreadPoolBuildError;
use rit_episode::{Episode, Stream};
use std::{slice, sync::Arc};

const TD_LOSS: Measure = Measure { name: "td_loss", help: "TD loss" };
const CONTRASTIVE_LOSS: Measure = Measure { name: "contrastive_loss", help: "Contrastive loss" };
const GRAD_NORM: Measure = Measure { name: "grad_norm", help: "Gradient norm before clipping" };
const Q_TOTAL_MEAN: Measure = Measure { name: "q_total_mean", help: "Mean Q_total" };
const TARGET_MEAN: Measure = Measure { name: "target_mean", help: "Mean TD target" };

/// With task representations.
const MEASURES: [Measure; 5] = [TD_LOSS, CONTRASTIVE_LOSS, GRAD_NORM, Q_TOTAL_MEAN, TARGET_MEAN];
/// Without.
const MEASURES_WITHOUT: [Measure; 4] = [TD_LOSS, GRAD_NORM, Q_TOTAL_MEAN, TARGET_MEAN];

/// RIT under training.
pub(super) struct RitLearner {
    model: Arc<Model>,
    update: Update,
}

impl RitLearner {
    pub(super) fn new(
        model: Arc<Model>,
        rit: Arc<Rit>,
        update: UpdateConfig,
        params: Vec<f32>,
    ) -> Result<Self, ThreadPoolBuildError> {
        Ok(Self { model, update: Update::new(rit, update, params)? })
    }

    fn has_task_representations(&self) -> bool {
        self.update.rit().task_encoder.is_some()
    }
}

impl Learner for RitLearner {
    fn model(&self) -> &Arc<Model> {
        &self.model
    }

    fn measures(&self) -> &'static [Measure] {
        if self.has_task_representations() { &MEASURES } else { &MEASURES_WITHOUT }
    }

    fn learn(&mut self, batch: &[&Episode], draw: Draw) -> Result<Vec<f64>, NotFinite> {
        let mut rng = draw.stream(Stream::Pairing);
        let losses = self.update.gradients(batch, |rows| contrastive::draw_pairing(rows, &mut rng));
        let Losses { td_loss, contrastive_loss, grad_norm, q_total_mean, target_mean } = losses;
        let mut values = vec![td_loss, contrastive_loss, grad_norm, q_total_mean, target_mean];
        if !self.has_task_representations() {
            values.remove(1);
        }
        NotFinite::check(self.measures(), &values)?;
        self.update.apply(losses.grad_norm);
        Ok(values)
    }

    fn update_target(&mut self) {
        self.update.update_target();
    }

    fn params(&self) -> &[f32] {
        &self.update.params
    }

    fn state(&self) -> Vec<NamedState<'_>> {
        let optimizer = &self.update.optimizer;
        vec![
            NamedState::f32("target", &self.update.target),
            NamedState::f32("optimizer.mean", &optimizer.mean),
            NamedState::f32("optimizer.mean_square", &optimizer.mean_square),
            NamedState::u64("optimizer.steps", slice::from_ref(&optimizer.steps)),
        ]
    }

    fn restore(&mut self, params: &[f32], state: &[NamedState<'_>]) -> Result<(), StateError> {
        let Update { params: own, target, optimizer, .. } = &mut self.update;
        let state = [state, &[NamedState::f32("params", params)]].concat();
        let places = vec![
            ("params", Place::F32(own)),
            ("target", Place::F32(target)),
            ("optimizer.mean", Place::F32(&mut optimizer.mean)),
            ("optimizer.mean_square", Place::F32(&mut optimizer.mean_square)),
            ("optimizer.steps", Place::U64(slice::from_mut(&mut optimizer.steps))),
        ];
        restore(places, &state)
    }
}
