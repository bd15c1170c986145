//! What TD learners' updates report.

use crate::learner::Measure;

/// L_TD.
pub const TD_LOSS: Measure = Measure { name: "td_loss", help: "TD loss" };
/// L_C.
pub const CONTRASTIVE_LOSS: Measure = Measure { name: "contrastive_loss", help: "Contrastive loss" };
/// ‖g‖ over all parameters.
pub const GRAD_NORM: Measure = Measure { name: "grad_norm", help: "Gradient norm before clipping" };
/// Q_total over filled steps.
pub const Q_TOTAL_MEAN: Measure = Measure { name: "q_total_mean", help: "Mean Q_total" };
/// y over filled steps.
pub const TARGET_MEAN: Measure = Measure { name: "target_mean", help: "Mean TD target" };

/// Of the agents' recurrent units. Where it nears 1, the network cannot tell states apart and hardly learns.
pub const SATURATED_UNITS: Measure =
    Measure { name: "saturated_units", help: "Share of agents' recurrent units beyond 0.99" };

/// What an update reports that has these losses of its own: what stands before and after them is the same for all methods,
/// in the order in which [`TdLearner::gradients`](super::TdLearner::gradients) gives the values. `gru`: whether agents
/// remember by a GRU.
pub const fn measures<const N: usize, const ALL: usize>(own: [Measure; N], gru: bool) -> [Measure; ALL] {
    const BEFORE: [Measure; 1] = [TD_LOSS];
    const AFTER: [Measure; 3] = [GRAD_NORM, Q_TOTAL_MEAN, TARGET_MEAN];
    let after = BEFORE.len() + N;
    let of_gru = after + AFTER.len();
    assert!(ALL == of_gru + gru as usize);
    let mut all = [SATURATED_UNITS; ALL];
    let mut at = 0;
    while at < of_gru {
        all[at] = if at < BEFORE.len() {
            BEFORE[at]
        } else if at < after {
            own[at - BEFORE.len()]
        } else {
            AFTER[at - after]
        };
        at += 1;
    }
    all
}

/// Of methods that have the TD loss alone, and no GRU.
pub const TD: [Measure; 4] = measures([], false);
/// Of methods that have the TD loss alone.
pub const TD_OF_GRU: [Measure; 5] = measures([], true);
/// Of methods with task representations.
pub const TD_AND_CONTRASTIVE: [Measure; 6] = measures([CONTRASTIVE_LOSS], true);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn losses_of_a_methods_own_stand_between_those_of_all() {
        let names = |measures: &[Measure]| measures.iter().map(|measure| measure.name).collect::<Vec<_>>();
        assert_eq!(names(&TD), ["td_loss", "grad_norm", "q_total_mean", "target_mean"]);
        assert_eq!(
            names(&TD_AND_CONTRASTIVE),
            ["td_loss", "contrastive_loss", "grad_norm", "q_total_mean", "target_mean", "saturated_units"]
        );
        assert_eq!(names(&TD_OF_GRU)[..4], names(&TD)[..]);
        assert_eq!(TD_OF_GRU[4], SATURATED_UNITS);
    }
}
