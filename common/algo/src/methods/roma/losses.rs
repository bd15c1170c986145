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
use rit_nn::{LayerNorm, LayoutBuilder, Linear, Tape, Var, View};

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

        let [m, v, x] = [roles.role.mean, roles.role.variance, roles.sample];
        let views = [m, v, x].map(|var| tape.view(var));
        let of = |row: usize| Normal { mean: views[0].row(row), variance: views[1].row(row) };
        let pairs = || first.iter().copied().zip(second.iter().copied());
        let mut by_i: Vec<f32> = pairs()
            .map(|(first, second)| dissimilarity::information(views[2].row(second), of(first)))
            .collect();
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
        let mut d = [m, v, x].map(|var| vec![0.0; var.len()]);
        for ((first, second), &by) in pairs().zip(&by_i) {
            let [d_m, d_v, d_x] = &mut d;
            let (of_first, of_second) = (first * dim..(first + 1) * dim, second * dim..(second + 1) * dim);
            let to = [&mut d_x[of_second], &mut d_m[of_first.clone()], &mut d_v[of_first]];
            dissimilarity::information_gradients(views[2].row(second), of(first), by, to);
        }
        for (by, signed) in by_d.iter_mut().zip(tape.slice(signed)) {
            *by *= if *signed < 0.0 { -1.0 } else { 1.0 };
        }
        for (var, d) in [m, v, x].into_iter().zip(&d) {
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
fn filled(rows: &Rows) -> impl Iterator<Item = usize> {
    let groups = rows.groups.iter().zip(&rows.steps).filter(|(_, step)| step.filled);
    groups.flat_map(|(group, _)| group.queries.clone())
}

/// The role's and the posterior's distribution of a row.
fn normals<'t>(tape: &'t Tape<'_>, roles: &Roles) -> impl Fn(usize) -> [Normal<'t>; 2] {
    let views =
        [roles.role, roles.posterior].map(|normal| [tape.view(normal.mean), tape.view(normal.variance)]);
    move |row| views.map(|[mean, variance]| Normal { mean: mean.row(row), variance: variance.row(row) })
}

/// Σ entropy and Σ divergence over the rows of steps that were taken.
pub(super) fn row_sums(tape: &Tape<'_>, rows: &Rows, roles: &Roles) -> [f64; 2] {
    let of_row = normals(tape, roles);
    filled(rows).fold([0.0; 2], |sums, row| {
        let [role, posterior] = of_row(row);
        let [entropy, divergence] = roles::row(role, posterior);
        [sums[0] + entropy, sums[1] + divergence]
    })
}

/// The loss of the roles themselves and its slope, from the means over the whole batch.
pub(super) fn role_loss(sums: &[f64], config: &RoleConfig) -> (f64, f64) {
    roles::loss(sums[0], sums[1], weights(config))
}

/// Seeds the tape with the gradients of [`role_loss`], `scale` being its slope by the number of rows.
pub(super) fn seed_rows(tape: &mut Tape<'_>, rows: &Rows, roles: &Roles, config: &RoleConfig, scale: f32) {
    let vars = [roles.role.mean, roles.role.variance, roles.posterior.mean, roles.posterior.variance];
    let mut d = vars.map(|var: Var| vec![0.0; var.len()]);
    let of_row = normals(tape, roles);
    for row in filled(rows) {
        let [role, posterior] = of_row(row);
        let to = d.each_mut().map(|d| &mut d[row * config.dim..(row + 1) * config.dim]);
        roles::row_gradients(role, posterior, weights(config), scale, to);
    }
    drop(of_row);
    for (var, d) in vars.into_iter().zip(&d) {
        tape.seed(var, View::dense(d, config.dim));
    }
}

fn weights(config: &RoleConfig) -> RoleWeights {
    RoleWeights { entropy: config.entropy_weight, divergence: config.kl_weight }
}
