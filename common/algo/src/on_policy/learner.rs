//! Proximal policy optimisation as a [`Learner`]: an update is all epochs over one batch.

use super::{ActorCritic, Losses, Ppo};
use crate::{
    Learner, Regime, UpdateConfig,
    estimators::value_norm::ValueNorm,
    learner::{Draw, Measure, NamedState, NotFinite, Numbers, Place, StateError, restore},
};
use rayon::ThreadPoolBuildError;
use rit_episode::{Episode, Stream};
use rit_nn::Layout;
use std::{ops::Range, slice, sync::Arc};

/// What every method of this objective reports, beside its gradients' norms: means over the optimiser steps of an
/// update, and the value normaliser after it.
pub const MEASURES: [Measure; 8] = [
    Measure { name: "policy_loss", help: "Clipped policy loss" },
    Measure { name: "value_loss", help: "Clipped value loss, in units of the returns' deviation" },
    Measure { name: "entropy", help: "Entropy of the policy where there is a choice" },
    Measure { name: "ratio_mean", help: "Mean probability ratio of actions taken, present to acting policy" },
    Measure { name: "clipped_share", help: "Share of probability ratios outside the clip" },
    Measure { name: "kl", help: "Divergence of the policy from the one that acted, estimated" },
    Measure { name: "value_mean", help: "Mean return, as the value normaliser has it" },
    Measure {
        name: "value_deviation",
        help: "Standard deviation of returns, as the value normaliser has it",
    },
];

/// [`MEASURES`], then the norms.
pub(crate) const fn measures<const N: usize, const ALL: usize>(norms: [Measure; N]) -> [Measure; ALL] {
    assert!(ALL == N + MEASURES.len());
    let mut all = [MEASURES[0]; ALL];
    let mut at = 0;
    while at < ALL {
        all[at] = if at < MEASURES.len() { MEASURES[at] } else { norms[at - MEASURES.len()] };
        at += 1;
    }
    all
}

/// An actor-critic under training.
pub struct PpoLearner<N> {
    network: Arc<N>,
    config: UpdateConfig,
    ppo: Ppo<N>,
}

impl<N: ActorCritic> PpoLearner<N> {
    /// Training from these parameters on.
    ///
    /// # Errors
    /// When the threads cannot be started.
    ///
    /// # Panics
    /// When `params` is not of the layout's length.
    pub fn new(
        network: Arc<N>,
        config: UpdateConfig,
        params: Vec<f32>,
    ) -> Result<Self, ThreadPoolBuildError> {
        let ppo = Ppo::new(Arc::clone(&network), config, params)?;
        Ok(Self { network, config, ppo })
    }

    /// The measures' values: means over optimiser steps.
    fn values(&self, steps: &[Losses]) -> Vec<f64> {
        let mean = |of: &dyn Fn(&Losses) -> f64| steps.iter().map(of).sum::<f64>() / steps.len() as f64;
        let mut values = vec![
            mean(&|losses| losses.sums.policy_loss),
            mean(&|losses| losses.sums.value_loss),
            mean(&|losses| losses.sums.entropy),
            mean(&|losses| losses.sums.ratio),
            mean(&|losses| losses.sums.clipped),
            mean(&|losses| losses.sums.kl),
            self.ppo.value_norm.center(),
            self.ppo.value_norm.deviation(),
        ];
        let norms = steps.first().map_or(0, |losses| losses.grad_norms.len());
        values.extend((0..norms).map(|index| mean(&|losses| losses.grad_norms[index])));
        values
    }
}

impl<N: ActorCritic> Learner for PpoLearner<N> {
    fn regime(&self) -> Regime {
        Regime::OnPolicy
    }

    fn layout(&self) -> &Layout {
        self.network.layout()
    }

    fn acting(&self) -> Range<usize> {
        self.network.acting()
    }

    fn measures(&self) -> &'static [Measure] {
        self.network.measures()
    }

    fn learn(&mut self, batch: &[&Episode], draw: Draw) -> Result<Vec<f64>, NotFinite> {
        let before = (self.ppo.params.clone(), self.ppo.optimizer.clone(), self.ppo.value_norm);
        let first = draw.update * self.config.ppo.epochs as u64;
        let steps = self.ppo.update(batch, |epoch| draw.seed.stream(Stream::Minibatches, first + epoch));
        let values = self.values(&steps);
        NotFinite::check(self.measures(), &values).inspect_err(|_| {
            (self.ppo.params, self.ppo.optimizer, self.ppo.value_norm) = before;
        })?;
        Ok(values)
    }

    fn params(&self) -> &[f32] {
        &self.ppo.params
    }

    fn state(&self) -> Vec<NamedState<'_>> {
        let Ppo { optimizer, value_norm: ValueNorm { mean, mean_square, debias }, .. } = &self.ppo;
        let value_norm = vec![*mean, *mean_square, *debias];
        vec![
            NamedState::f32("optimizer.mean", &optimizer.mean),
            NamedState::f32("optimizer.mean_square", &optimizer.mean_square),
            NamedState::u64("optimizer.steps", slice::from_ref(&optimizer.steps)),
            NamedState { name: "value_norm", numbers: Numbers::F64(value_norm.into()) },
        ]
    }

    fn restore(&mut self, params: &[f32], state: &[NamedState<'_>]) -> Result<(), StateError> {
        let mut value_norm = [0.0; 3];
        let Ppo { params: own, optimizer, .. } = &mut self.ppo;
        let state = [state, &[NamedState::f32("params", params)]].concat();
        let places = vec![
            ("params", Place::F32(own)),
            ("optimizer.mean", Place::F32(&mut optimizer.mean)),
            ("optimizer.mean_square", Place::F32(&mut optimizer.mean_square)),
            ("optimizer.steps", Place::U64(slice::from_mut(&mut optimizer.steps))),
            ("value_norm", Place::F64(&mut value_norm)),
        ];
        restore(places, &state)?;
        let [mean, mean_square, debias] = value_norm;
        self.ppo.value_norm = ValueNorm { mean, mean_square, debias };
        Ok(())
    }
}
