//! A method with a policy network as the rest of the service knows it.

use super::{ActorCritic, PpoLearner};
use crate::{
    Learner, UpdateConfig,
    networks::{Actor, EpisodeValues, Networks},
};
use rayon::ThreadPoolBuildError;
use rit_episode::{Action, Episode};
use rit_nn::Layout;
use std::{ops::Range, sync::Arc};

/// Networks that learn by proximal policy optimisation.
#[derive(Debug)]
pub(crate) struct ByPolicy<N>(Arc<N>);

impl<N> ByPolicy<N> {
    /// Of these networks.
    pub(crate) fn new(network: N) -> Self {
        Self(Arc::new(network))
    }
}

impl<N: ActorCritic> Networks for ByPolicy<N> {
    fn layout(&self) -> &Layout {
        self.0.layout()
    }

    fn acting(&self) -> Range<usize> {
        self.0.acting()
    }

    fn learner(
        &self,
        update: UpdateConfig,
        params: Vec<f32>,
    ) -> Result<Box<dyn Learner>, ThreadPoolBuildError> {
        Ok(Box::new(PpoLearner::new(Arc::clone(&self.0), update, params)?))
    }

    fn actor(&self, params: &[f32]) -> Box<dyn Actor> {
        Arc::clone(&self.0).actor(params)
    }

    fn value(&self, _params: &[f32], _episode: &Episode, _actions: &[Action]) -> Option<EpisodeValues> {
        None
    }
}
