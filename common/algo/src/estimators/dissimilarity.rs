//! ROMA's loss between roles: two agents' roles should tell of each other, or be far apart.
//!
//! Of one step with n agents, over all n² ordered pairs (i = j among them):
//! L_D = n⁻² Σ [d̂ − κ min(î + d̂, 1)], where î and d̂ are information and dissimilarity brought to 0 … 1 by the least
//! and the greatest of the step: x̂ = (x − lo) / (hi − lo + 1e-12).

use super::roles::Normal;
use rit_nn::gaussian;

/// What keeps the logarithm of a density in bounds: i = mean over dimensions of max(ln N + 13.9, −13.9).
const BOUND: f32 = 13.9;

/// How much role `x` tells of an agent whose role is drawn from `of`.
#[inline(always)]
pub fn information(x: &[f32], of: Normal<'_>) -> f32 {
    let mut sum = 0.0;
    for (dim, &x) in x.iter().enumerate() {
        sum += (gaussian::log_density(x, of.mean[dim], of.variance[dim]) + BOUND).max(-BOUND);
    }
    sum / x.len() as f32
}

/// Adds `d` times [`information`]'s gradients by x, mean and variance. Nothing passes at the floor.
#[inline(always)]
pub fn information_gradients(x: &[f32], of: Normal<'_>, d: f32, to: [&mut [f32]; 3]) {
    let [d_x, d_mean, d_variance] = to;
    let d = d / x.len() as f32;
    for dim in 0..x.len() {
        let (x, m, v) = (x[dim], of.mean[dim], of.variance[dim]);
        if gaussian::log_density(x, m, v) + BOUND > -BOUND {
            let by = gaussian::log_density_gradients(x, m, v);
            d_x[dim] += d * by[0];
            d_mean[dim] += d * by[1];
            d_variance[dim] += d * by[2];
        }
    }
}

/// One step's L_D from information and dissimilarity of its pairs, `[n²]` each. Leaves `scale` times its gradients by
/// them in their places.
pub fn loss(information: &mut [f32], dissimilarity: &mut [f32], constraint: f32, scale: f32) -> f64 {
    let (i, d) = (Range::of(information), Range::of(dissimilarity));
    let (constraint, pairs) = (f64::from(constraint), information.len() as f64);
    let share = f64::from(scale) / pairs;
    let mut sum = 0.0;
    let mut ends = [[0.0; 2]; 2];
    for (information, dissimilarity) in information.iter_mut().zip(dissimilarity.iter_mut()) {
        let (of_i, of_d) = (i.scaled(*information), d.scaled(*dissimilarity));
        let free = of_i + of_d < 1.0;
        sum += of_d - constraint * (of_i + of_d).min(1.0);
        let by_i = if free { -constraint * share } else { 0.0 };
        let by_d = share + by_i;
        for ((range, x), (by, ends)) in
            [(&i, information), (&d, dissimilarity)].into_iter().zip([by_i, by_d].into_iter().zip(&mut ends))
        {
            let scaled = range.scaled(*x);
            ends[0] += by * (scaled - 1.0) / range.width;
            ends[1] -= by * scaled / range.width;
            *x = (by / range.width) as f32;
        }
    }
    for (range, x, ends) in [(i, information, ends[0]), (d, dissimilarity, ends[1])] {
        x[range.least] += ends[0] as f32;
        x[range.greatest] += ends[1] as f32;
    }
    sum / pairs
}

/// Where the least and the greatest of some numbers are, the first of each.
#[derive(Clone, Copy, Debug)]
struct Range {
    least: usize,
    greatest: usize,
    low: f64,
    width: f64,
}

impl Range {
    fn of(x: &[f32]) -> Self {
        let (mut least, mut greatest) = (0, 0);
        for (at, &value) in x.iter().enumerate() {
            if value < x[least] {
                least = at;
            }
            if value > x[greatest] {
                greatest = at;
            }
        }
        let (low, high) = (f64::from(x[least]), f64::from(x[greatest]));
        Self { least, greatest, low, width: high - low + 1e-12 }
    }

    fn scaled(&self, x: f32) -> f64 {
        (f64::from(x) - self.low) / self.width
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_nn::gradcheck::check;

    /// Two agents. i scales to 1, 0.25, 0, 0.5 and d to 0, 0.5, 0.5, 1: sums 1, 0.75, 0.5, 1.5 of which 1 counts at
    /// most. Σ d̂ = 2, Σ min = 3.25.
    #[test]
    fn a_step_by_hand() {
        let (mut i, mut d) = ([5.0, 2.0, 1.0, 3.0], [1.0, 2.0, 2.0, 3.0]);
        let value = loss(&mut i, &mut d, 0.5, 4.0);
        assert!((value - (2.0 - 0.5 * 3.25) / 4.0).abs() < 1e-9, "{value}");
        // Scale and n² cancel: 1 − κ by each d̂, −κ by each î of the first three pairs, that is −½ and ½, and 1 by the
        // last d̂. By i, a quarter as much; the least takes (î − 1)/4 and the greatest −î/4 of each.
        let by_i = [-0.5, -0.5, -0.5, 0.0];
        let scaled = [1.0, 0.25, 0.0, 0.5];
        let least: f32 = (0..4).map(|at| by_i[at] * (scaled[at] - 1.0) / 4.0).sum();
        let greatest: f32 = (0..4).map(|at| -by_i[at] * scaled[at] / 4.0).sum();
        let expected = [-0.125 + greatest, -0.125, -0.125 + least, 0.0];
        for (a, b) in i.iter().zip(expected) {
            assert!((a - b).abs() < 1e-6, "{i:?} {expected:?}");
        }
        assert!(i.iter().sum::<f32>().abs() < 1e-6 && d.iter().sum::<f32>().abs() < 1e-6, "no shift shows");
    }

    #[test]
    fn one_agent_has_nothing_to_differ_from() {
        let (mut i, mut d) = ([5.0], [2.0]);
        assert_eq!(loss(&mut i, &mut d, 0.7, 1.0), 0.0);
        assert_eq!((i, d), ([0.0], [0.0]));
    }

    #[test]
    fn gradients_are_the_numeric_ones() {
        let at = [
            0.3, -0.8, 0.55, 0.4, 1.1, 0.7, -0.2, 0.1, 0.62, 0.9, 0.5, 1.3, 0.25, 0.45, 0.85, 0.2, 0.95, 0.66,
        ];
        let (mut i, mut d) = (at[..9].to_vec(), at[9..].to_vec());
        loss(&mut i, &mut d, 0.7, 2.0);
        check("pairs", &at, &[i, d].concat(), |x| {
            2.0 * loss(&mut x[..9].to_vec(), &mut x[9..].to_vec(), 0.7, 1.0)
        });
    }

    #[test]
    fn information_has_a_floor_that_passes_nothing() {
        let of = Normal { mean: &[0.0, 0.5], variance: &[1.0, 0.002] };
        // ln N(1; 0, 1) = −1.418939; the second is about −0.9189 + 3.1073 − 562.5, far below.
        let x = [1.0, 2.0];
        assert!((information(&x, of) - 0.5 * (13.9 - 1.418_938_5 - 13.9)).abs() < 1e-5);
        let (mut dx, mut dm, mut dv) = ([0.0; 2], [0.0; 2], [0.0; 2]);
        information_gradients(&x, of, 3.0, [&mut dx, &mut dm, &mut dv]);
        assert_eq!((dx, dm, dv), ([-1.5, 0.0], [1.5, 0.0], [0.0, 0.0]));
        let at = [0.3, -0.2, 0.1, 0.5, 0.8, 0.6];
        let value = |x: &[f32]| f64::from(information(&x[..2], Normal { mean: &x[2..4], variance: &x[4..] }));
        let mut d = [0.0; 6];
        let (dx, rest) = d.split_at_mut(2);
        let (dm, dv) = rest.split_at_mut(2);
        information_gradients(&at[..2], Normal { mean: &at[2..4], variance: &at[4..] }, 1.0, [dx, dm, dv]);
        check("information", &at, &d, value);
    }
}
