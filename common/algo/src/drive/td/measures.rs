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

/// Of methods that have the TD loss alone, and no GRU.
pub const TD: [Measure; 4] = [TD_LOSS, GRAD_NORM, Q_TOTAL_MEAN, TARGET_MEAN];
/// Of methods that have the TD loss alone.
pub const TD_OF_GRU: [Measure; 5] = [TD_LOSS, GRAD_NORM, Q_TOTAL_MEAN, TARGET_MEAN, SATURATED_UNITS];
/// Of methods with task representations.
pub const TD_AND_CONTRASTIVE: [Measure; 6] =
    [TD_LOSS, CONTRASTIVE_LOSS, GRAD_NORM, Q_TOTAL_MEAN, TARGET_MEAN, SATURATED_UNITS];
