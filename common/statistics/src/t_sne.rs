//! t-SNE: points of many dimensions on a map of two, neighbours beside neighbours (van der Maaten and Hinton,
//! *Visualizing Data using t-SNE*, 2008). The exact algorithm, for some thousand points.
//!
//! The crates there are sum in parallel, so that their map follows from the timing of threads; this one is a fact of its
//! seed.

use crate::distance;
use rand::RngExt as _;
use rit_episode::Rng;

/// Steps of gradient descent.
const STEPS: usize = 1000;
/// So many steps, similarities are exaggerated so much, and the momentum is the lower one.
const EARLY_STEPS: usize = 250;
const EXAGGERATION: f64 = 12.0;
const MOMENTUM: [f64; 2] = [0.5, 0.8];
/// Halvings of the interval in which a point's bandwidth is looked for.
const BANDWIDTH_STEPS: usize = 60;
/// No similarity is less than this.
const TINY: f64 = 1e-12;

/// A map of points.
#[derive(Clone, Debug, PartialEq)]
pub struct Map {
    /// Where each lies.
    pub places: Vec<[f64; 2]>,
    /// Kullback and Leibler's divergence of the map's neighbourhoods from the points' own: 0 shows them as they are.
    pub divergence: f64,
}

/// Most neighbours that a point of so many can be said to have: the perplexity is no higher.
pub fn perplexity_max(points: usize) -> f64 {
    (points.saturating_sub(1) as f64 / 3.0).max(1.0)
}

/// Maps the points. The perplexity, about the number of neighbours that each point minds, is brought down to
/// [`perplexity_max`].
pub fn map(points: &[Vec<f32>], perplexity: f64, rng: &mut Rng) -> Map {
    let count = points.len();
    if count < 2 {
        return Map { places: vec![[0.0; 2]; count], divergence: 0.0 };
    }
    let similarities = similarities(points, perplexity.min(perplexity_max(count)));
    let rate = (count as f64 / EXAGGERATION / 4.0).max(50.0);
    let mut places: Vec<[f64; 2]> = (0..count).map(|_| [0; 2].map(|_| 1e-4 * normal(rng))).collect();
    let mut speeds = vec![[0.0; 2]; count];
    let mut gains = vec![[1.0_f64; 2]; count];
    for step in 0..STEPS {
        let early = step < EARLY_STEPS;
        let exaggeration = if early { EXAGGERATION } else { 1.0 };
        let gradient = gradient(&places, &similarities, exaggeration);
        for at in 0..count {
            for axis in 0..2 {
                let (slope, speed) = (gradient[at][axis], &mut speeds[at][axis]);
                let gain = &mut gains[at][axis];
                *gain = if (slope > 0.0) == (*speed > 0.0) { *gain * 0.8 } else { *gain + 0.2 }.max(0.01);
                *speed = MOMENTUM[usize::from(!early)] * *speed - rate * *gain * slope;
                places[at][axis] += *speed;
            }
        }
        centre(&mut places);
    }
    let divergence = divergence(&places, &similarities);
    Map { places, divergence }
}

/// A draw from the standard normal distribution (Box and Muller).
fn normal(rng: &mut Rng) -> f64 {
    let (u, v): (f64, f64) = (1.0 - rng.random::<f64>(), rng.random());
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

/// `[n][n]`: how much of a neighbour each is to each, summing to one.
fn similarities(points: &[Vec<f32>], perplexity: f64) -> Vec<f64> {
    let count = points.len();
    let mut conditional = vec![0.0; count * count];
    for (at, row) in conditional.chunks_exact_mut(count).enumerate() {
        let squares: Vec<f64> = points.iter().map(|other| distance(&points[at], other).powi(2)).collect();
        neighbourhood(at, &squares, perplexity, row);
    }
    let joint = |pair: usize| {
        let (i, j) = (pair / count, pair % count);
        let sum = conditional[i * count + j] + conditional[j * count + i];
        (sum / (2 * count) as f64).max(TINY)
    };
    (0..count * count).map(joint).collect()
}

/// One point's neighbours, by a bell curve as wide as gives them this perplexity.
fn neighbourhood(own: usize, squares: &[f64], perplexity: f64, row: &mut [f64]) {
    let others = || squares.iter().enumerate().filter(|(at, _)| *at != own).map(|(_, square)| *square);
    let nearest = others().fold(f64::INFINITY, f64::min);
    let (mut low, mut high, mut precision) = (0.0, f64::INFINITY, 1.0);
    for _ in 0..BANDWIDTH_STEPS {
        for ((at, weight), square) in row.iter_mut().enumerate().zip(squares) {
            // Less the nearest, which cancels: a far point's weights would all be 0.
            *weight = if at == own { 0.0 } else { (-(square - nearest) * precision).exp() };
        }
        let sum: f64 = row.iter().sum();
        row.iter_mut().for_each(|weight| *weight /= sum);
        let entropy: f64 =
            -row.iter().filter(|&&share| share > 0.0).map(|share| share * share.ln()).sum::<f64>();
        if entropy > perplexity.ln() {
            low = precision;
            precision = if high.is_finite() { f64::midpoint(low, high) } else { precision * 2.0 };
        } else {
            high = precision;
            precision = f64::midpoint(low, high);
        }
    }
}

/// Student's weight of two places on the map.
fn weight(a: [f64; 2], b: [f64; 2]) -> f64 {
    1.0 / (1.0 + (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2))
}

fn weights_sum(places: &[[f64; 2]]) -> f64 {
    let pairs = places.iter().enumerate().flat_map(|(at, &a)| places[..at].iter().map(move |&b| (a, b)));
    pairs.map(|(a, b)| 2.0 * weight(a, b)).sum()
}

fn gradient(places: &[[f64; 2]], similarities: &[f64], exaggeration: f64) -> Vec<[f64; 2]> {
    let sum = weights_sum(places);
    let of_place = |(at, &place): (usize, &[f64; 2])| {
        let row = &similarities[at * places.len()..][..places.len()];
        row.iter().zip(places).fold([0.0; 2], |[x, y], (similarity, &other)| {
            let weight = weight(place, other);
            let pull = 4.0 * (exaggeration * similarity - weight / sum) * weight;
            [x + pull * (place[0] - other[0]), y + pull * (place[1] - other[1])]
        })
    };
    places.iter().enumerate().map(of_place).collect()
}

fn divergence(places: &[[f64; 2]], similarities: &[f64]) -> f64 {
    let (sum, count) = (weights_sum(places), places.len());
    let of_pair = |(pair, similarity): (usize, &f64)| {
        let (i, j) = (pair / count, pair % count);
        let shown = (weight(places[i], places[j]) / sum).max(TINY);
        if i == j { 0.0 } else { similarity * (similarity / shown).ln() }
    };
    similarities.iter().enumerate().map(of_pair).sum()
}

fn centre(places: &mut [[f64; 2]]) {
    let count = places.len() as f64;
    for axis in 0..2 {
        let middle = places.iter().map(|place| place[axis]).sum::<f64>() / count;
        places.iter_mut().for_each(|place| place[axis] -= middle);
    }
}
