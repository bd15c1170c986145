//! The TD learner as a trainer knows it.

use super::{TdLearner, ValueNetwork};
use crate::{
    Learner, Regime,
    blocks::draw_pairing,
    learner::{Draw, Measure, NamedState, NotFinite, Place, StateError, restore},
};
use rit_episode::{Episode, Stream};
use rit_nn::Layout;
use std::{ops::Range, slice};

impl<N: ValueNetwork> Learner for TdLearner<N> {
    fn regime(&self) -> Regime {
        Regime::Replay
    }

    fn layout(&self) -> &Layout {
        &self.network.parts().layout
    }

    fn acting(&self) -> Range<usize> {
        self.network.parts().acting.clone()
    }

    fn measures(&self) -> &'static [Measure] {
        self.network.measures()
    }

    fn learn(&mut self, batch: &[&Episode], draw: Draw) -> Result<Vec<f64>, NotFinite> {
        let mut rng = draw.stream(Stream::Pairing);
        let draws = self.network.draw(batch, draw);
        let values = self.gradients(batch, &draws, |rows| draw_pairing(rows, &mut rng));
        NotFinite::check(self.measures(), &values)?;
        self.apply();
        Ok(values)
    }

    fn update_target(&mut self) {
        Self::update_target(self);
    }

    fn params(&self) -> &[f32] {
        &self.params
    }

    fn state(&self) -> Vec<NamedState<'_>> {
        vec![
            NamedState::f32("target", &self.target),
            NamedState::f32("optimizer.mean", &self.optimizer.mean),
            NamedState::f32("optimizer.mean_square", &self.optimizer.mean_square),
            NamedState::u64("optimizer.steps", slice::from_ref(&self.optimizer.steps)),
        ]
    }

    fn restore(&mut self, params: &[f32], state: &[NamedState<'_>]) -> Result<(), StateError> {
        let Self { params: own, target, optimizer, .. } = self;
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
