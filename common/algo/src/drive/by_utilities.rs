//! A method with utilities as the rest of the service knows it.

use super::{TdLearner, ValueActing, ValueNetwork, values::value};
use crate::{
    Learner, UpdateConfig,
    networks::{Actor, EpisodeValues, Networks},
};
use rayon::ThreadPoolBuildError;
use rit_episode::{Action, Episode};
use rit_nn::Layout;
use std::{ops::Range, sync::Arc};

/// Networks that learn by temporal differences and act ε-greedily.
#[derive(Debug)]
pub(crate) struct ByUtilities<N>(Arc<N>);

impl<N> ByUtilities<N> {
    /// Of these networks.
    pub(crate) fn new(network: N) -> Self {
        Self(Arc::new(network))
    }
}

impl<N: ValueNetwork> Networks for ByUtilities<N> {
    fn layout(&self) -> &Layout {
        &self.0.parts().layout
    }

    fn acting(&self) -> Range<usize> {
        self.0.parts().acting.clone()
    }

    fn learner(
        &self,
        update: UpdateConfig,
        params: Vec<f32>,
    ) -> Result<Box<dyn Learner>, ThreadPoolBuildError> {
        Ok(Box::new(TdLearner::new(Arc::clone(&self.0), update, params)?))
    }

    fn actor(&self, params: &[f32]) -> Box<dyn Actor> {
        Box::new(ValueActing::new(Arc::clone(&self.0), params))
    }

    fn value(&self, params: &[f32], episode: &Episode, actions: &[Action]) -> Option<EpisodeValues> {
        (!N::DRAWS).then(|| value(self.0.as_ref(), params, episode, actions))
    }
}
