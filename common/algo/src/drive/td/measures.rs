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

/// Of methods that have the TD loss alone.
pub const TD: [Measure; 4] = [TD_LOSS, GRAD_NORM, Q_TOTAL_MEAN, TARGET_MEAN];
/// Of methods with task representations.
pub const TD_AND_CONTRASTIVE: [Measure; 5] =
    [TD_LOSS, CONTRASTIVE_LOSS, GRAD_NORM, Q_TOTAL_MEAN, TARGET_MEAN];
