//! Standard normal numbers in bulk, the same on every machine.

use crate::{math, vectorized};
use rand::Rng;

/// Numbers made at once.
const CHUNK: usize = 256;

/// Fills with independent standard normal numbers (Box and Muller). Each pair of numbers takes two draws of 32 bits; if the
/// length is odd, the second number of the last pair is discarded.
pub fn fill_standard_normal(rng: &mut impl Rng, to: &mut [f32]) {
    let (mut radii, mut turns) = ([0.0; CHUNK / 2], [0.0; CHUNK / 2]);
    for to in to.chunks_mut(CHUNK) {
        let pairs = to.len().div_ceil(2);
        for (radius, turn) in radii.iter_mut().zip(&mut turns).take(pairs) {
            // 24 bits each: the first in (0, 1], so that its logarithm is finite.
            *radius = ((rng.next_u32() >> 8) + 1) as f32 * (1.0 / (1 << 24) as f32);
            *turn = (rng.next_u32() >> 8) as f32 * (1.0 / (1 << 24) as f32);
        }
        transform(&mut radii[..pairs], &mut turns[..pairs]);
        for (pair, (radius, turn)) in to.chunks_mut(2).zip(radii.iter().zip(&turns)) {
            pair[0] = *radius;
            if let Some(second) = pair.get_mut(1) {
                *second = *turn;
            }
        }
    }
}

vectorized! {
    /// From uniform numbers to normal ones, in place: √(−2 ln u) cos 2πv and √(−2 ln u) sin 2πv.
    fn transform<'a>(u: &'a mut [f32], v: &'a mut [f32]) {
        for (u, v) in u.iter_mut().zip(&mut *v) {
            let radius = (-2.0 * math::ln(*u)).max(0.0).sqrt();
            let (sin, cos) = math::sin_cos_of_turns(*v);
            (*u, *v) = (radius * cos, radius * sin);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn have_the_moments_of_the_normal_distribution() {
        let mut x = vec![0.0; 100_001];
        fill_standard_normal(&mut ChaCha8Rng::seed_from_u64(1), &mut x);
        let moment = |power| x.iter().map(|&x| f64::from(x).powi(power)).sum::<f64>() / x.len() as f64;
        // Standard deviations of the estimates: 0.003, 0.0045, 0.012, 0.03.
        assert!(moment(1).abs() < 0.015 && (moment(2) - 1.0).abs() < 0.02, "{} {}", moment(1), moment(2));
        assert!(moment(3).abs() < 0.06 && (moment(4) - 3.0).abs() < 0.15, "{} {}", moment(3), moment(4));
        let neighbours: f64 = x.windows(2).map(|pair| f64::from(pair[0] * pair[1])).sum::<f64>() / 1e5;
        assert!(neighbours.abs() < 0.015, "{neighbours}");
    }

    #[test]
    fn are_what_the_definition_says() {
        let mut x = [0.0; 5];
        fill_standard_normal(&mut ChaCha8Rng::seed_from_u64(7), &mut x);
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let mut uniform = || f64::from(rng.next_u32() >> 8) / f64::from(1 << 24);
        for pair in x.chunks(2) {
            let (u, v) = (uniform() + 1.0 / f64::from(1 << 24), uniform());
            let (radius, angle) = ((-2.0 * u.ln()).sqrt(), std::f64::consts::TAU * v);
            for (ours, theirs) in pair.iter().zip([radius * angle.cos(), radius * angle.sin()]) {
                assert!((f64::from(*ours) - theirs).abs() < 2e-6, "{ours} {theirs}");
            }
        }
    }
}
