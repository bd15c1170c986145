//! ROMA's own losses, from what a shard's pass left on the tape.

use super::{Roles, Roma};
use crate::{
    RoleConfig, Rows,
    drive::{Said, TdPass},
    estimators::{
        dissimilarity,
        roles::{self, Normal, RoleWeights},
    },
};
use rit_nn::{LayerNorm, LayoutBuilder, Linear, Tape, Var, View, vectorized};

/// D(ρ_i, ρ_j) = |`out`(LeakyReLU(`norm`(`hidden`([ρ_i ‖ ρ_j]))))|.
#[derive(Clone, Debug)]
pub(super) struct Dissimilarity {
    /// 2l → r.
    hidden: Linear,
    norm: LayerNorm,
    /// r → 1.
    out: Linear,
}

impl Dissimilarity {
    /// Declares `role_dissimilarity.…`.
    pub(super) fn new(layout: &mut LayoutBuilder, dim: usize, hidden_dim: usize) -> Self {
        Self {
            hidden: Linear::new(layout, "role_dissimilarity.hidden", 2 * dim, hidden_dim),
            norm: LayerNorm::new(layout, "role_dissimilarity.norm", hidden_dim),
            out: Linear::new(layout, "role_dissimilarity.out", hidden_dim, 1),
        }
    }

    /// A shard's share of L_D; seeds the tape with w_D times its gradients.
    pub(super) fn loss<'a>(
        &self,
        tape: &mut Tape<'a>,
        pass: &TdPass<'a, '_, Roma>,
        roles: &Roles,
        config: &RoleConfig,
        said: &mut Said,
    ) -> f64 {
        let [first, second] = &pass.inputs.pairs;
        if first.is_empty() {
            return 0.0;
        }
        let dim = config.dim;
        let both = tape.reserve(first.len(), 2 * dim);
        tape.gather_into(roles.sample, first, both.columns(0..dim));
        tape.gather_into(roles.sample, second, both.columns(dim..2 * dim));
        let hidden = tape.linear(&self.hidden, both);
        let normed = tape.layer_norm(&self.norm, hidden);
        let active = tape.leaky_relu(normed);
        let signed = tape.linear(&self.out, active);

        let vars = [roles.role.mean, roles.role.variance, roles.sample];
        let views = vars.map(|var| tape.view(var));
        let mut by_i = vec![0.0; first.len()];
        informations(views, [first, second], &mut by_i);
        let mut by_d: Vec<f32> = tape.slice(signed).iter().map(|signed| signed.abs()).collect();
        let named = [by_i.clone(), by_d.clone()];

        // From pairs to what they come of.
        let scale = config.dissimilarity_weight / pass.totals.filled as f32;
        let mut sum = 0.0;
        let (mut rest_i, mut rest_d) = (&mut by_i[..], &mut by_d[..]);
        let taken = pass.rows.groups.iter().zip(&pass.rows.steps).filter(|(_, step)| step.filled);
        for (group, _) in taken {
            let pairs = group.queries.len() * group.queries.len();
            let (of_i, of_d);
            (of_i, rest_i) = rest_i.split_at_mut(pairs);
            (of_d, rest_d) = rest_d.split_at_mut(pairs);
            sum += dissimilarity::loss(of_i, of_d, config.soft_constraint, scale);
        }
        let mut d = vars.map(|var| vec![0.0; var.len()]);
        informations_backward(views, [first, second], &by_i, d.each_mut().map(Vec::as_mut_slice));
        for (by, signed) in by_d.iter_mut().zip(tape.slice(signed)) {
            *by *= if *signed < 0.0 { -1.0 } else { 1.0 };
        }
        for (var, d) in vars.into_iter().zip(&d) {
            tape.seed(var, View::dense(d, dim));
        }
        tape.seed(signed, View::dense(&by_d, 1));
        for (name, values) in ["role_information", "role_dissimilarity"].into_iter().zip(named) {
            let mut buffer = tape.take(values.len());
            buffer.copy_from_slice(&values);
            said.push((name, tape.push_detached(buffer, 1)));
        }
        sum / pass.totals.filled as f64
    }
}

/// Agent rows of steps that were taken.
fn filled(rows: &Rows) -> Vec<usize> {
    let groups = rows.groups.iter().zip(&rows.steps).filter(|(_, step)| step.filled);
    groups.flat_map(|(group, _)| group.queries.clone()).collect()
}

/// Means and variances of roles, then of their posteriors.
fn distributions(roles: &Roles) -> [Var; 4] {
    [roles.role.mean, roles.role.variance, roles.posterior.mean, roles.posterior.variance]
}

/// Σ entropy and Σ divergence over the rows of steps that were taken.
pub(super) fn row_sums(tape: &Tape<'_>, rows: &Rows, roles: &Roles) -> [f64; 2] {
    sum_rows(distributions(roles).map(|var| tape.view(var)), &filled(rows))
}

vectorized! {
    fn sum_rows<'a>(distributions: [View<'a>; 4], rows: &'a [usize]) -> [f64; 2] {
        let mut sums = [0.0; 2];
        for &row in rows {
            let [role, posterior] = normals(distributions, row);
            let [entropy, divergence] = roles::row(role, posterior);
            sums[0] += entropy;
            sums[1] += divergence;
        }
        sums
    }
}

vectorized! {
    /// Writes the gradients by these rows' distributions.
    fn rows_backward<'a>(
        distributions: [View<'a>; 4],
        rows: &'a [usize],
        weights: RoleWeights,
        scale: f32,
        d: [&'a mut [f32]; 4],
    ) {
        let [d_mean, d_variance, d_mean_to, d_variance_to] = d;
        for &row in rows {
            let [role, posterior] = normals(distributions, row);
            let of_row = row * role.mean.len()..(row + 1) * role.mean.len();
            let to = [
                &mut d_mean[of_row.clone()],
                &mut d_variance[of_row.clone()],
                &mut d_mean_to[of_row.clone()],
                &mut d_variance_to[of_row],
            ];
            roles::row_gradients(role, posterior, weights, scale, to);
        }
    }
}

/// The role's and the posterior's distribution of a row.
#[inline(always)]
fn normals<'a>([mean, variance, mean_to, variance_to]: [View<'a>; 4], row: usize) -> [Normal<'a>; 2] {
    let role = Normal { mean: mean.row(row), variance: variance.row(row) };
    [role, Normal { mean: mean_to.row(row), variance: variance_to.row(row) }]
}

vectorized! {
    /// How much the role of each pair's second row tells of its first, from means, variances and roles.
    fn informations<'a>(of: [View<'a>; 3], pairs: [&'a [usize]; 2], to: &'a mut [f32]) {
        let ([mean, variance, x], [first, second]) = (of, pairs);
        for (pair, to) in to.iter_mut().enumerate() {
            let (first, second) = (first[pair], second[pair]);
            let normal = Normal { mean: mean.row(first), variance: variance.row(first) };
            *to = dissimilarity::information(x.row(second), normal);
        }
    }
}

vectorized! {
    /// From the gradients by pairs, adds to those by means, variances and roles.
    fn informations_backward<'a>(
        of: [View<'a>; 3],
        pairs: [&'a [usize]; 2],
        by: &'a [f32],
        d: [&'a mut [f32]; 3],
    ) {
        let ([mean, variance, x], [first, second]) = (of, pairs);
        let [d_mean, d_variance, d_x] = d;
        let dim = x.cols;
        for (pair, &by) in by.iter().enumerate() {
            let (first, second) = (first[pair], second[pair]);
            let normal = Normal { mean: mean.row(first), variance: variance.row(first) };
            let (of_first, of_second) = (first * dim..(first + 1) * dim, second * dim..(second + 1) * dim);
            let to = [&mut d_x[of_second], &mut d_mean[of_first.clone()], &mut d_variance[of_first]];
            dissimilarity::information_gradients(x.row(second), normal, by, to);
        }
    }
}

/// The loss of the roles themselves and its slope, from the means over the whole batch.
pub(super) fn role_loss(sums: &[f64], config: &RoleConfig) -> (f64, f64) {
    roles::loss(sums[0], sums[1], weights(config))
}

/// Seeds the tape with the gradients of [`role_loss`], `scale` being its slope by the number of rows.
pub(super) fn seed_rows(tape: &mut Tape<'_>, rows: &Rows, roles: &Roles, config: &RoleConfig, scale: f32) {
    let vars = distributions(roles);
    let mut d = vars.map(|var| vec![0.0; var.len()]);
    let to = d.each_mut().map(Vec::as_mut_slice);
    rows_backward(vars.map(|var| tape.view(var)), &filled(rows), weights(config), scale, to);
    for (var, d) in vars.into_iter().zip(&d) {
        tape.seed(var, View::dense(d, config.dim));
    }
}

fn weights(config: &RoleConfig) -> RoleWeights {
    RoleWeights { entropy: config.entropy_weight, divergence: config.kl_weight }
}
