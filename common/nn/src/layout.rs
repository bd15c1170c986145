//! Names and shapes of all parameters, declared once, in the order in which they lie in the flat buffer.

use crate::Derived;
use rand::{Rng, RngExt as _};
use std::ops::Range;

/// One parameter: where it lies and how it begins.
#[derive(Clone, Debug, PartialEq)]
pub struct Param {
    /// Its name in a checkpoint, such as `utility.gru.weight_ih`.
    pub name: String,
    /// Its shape as PyTorch has it: (out, in) for a weight.
    pub shape: Vec<usize>,
    /// Where it lies in the flat buffer.
    pub range: Range<usize>,
    /// How its values begin.
    pub initial: Initial,
}

/// How a parameter's values begin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Initial {
    /// Uniform in ± this.
    Uniform(f32),
    /// All 0.
    Zeros,
    /// All 1.
    Ones,
    /// A matrix of orthonormal rows or columns, whichever are fewer, times this.
    Orthogonal(f32),
}

/// All parameters of a model.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Layout {
    params: Vec<Param>,
    len: usize,
    derived: Derived,
}

impl Layout {
    /// Declares a network that may have derived layers. They lie after all of its parameters, so it declares itself
    /// twice: the first time only counts.
    pub fn of<T>(declare: impl Fn(&mut LayoutBuilder) -> T) -> (T, Self) {
        let mut counting = LayoutBuilder::default();
        declare(&mut counting);
        let mut builder = LayoutBuilder::default();
        builder.layout.derived = Derived::new(counting.len());
        let network = declare(&mut builder);
        (network, builder.finish())
    }

    /// The layers that are made of others.
    pub fn derived(&self) -> &Derived {
        &self.derived
    }

    /// Every parameter, in the buffer's order.
    pub fn params(&self) -> &[Param] {
        &self.params
    }

    /// Numbers in the flat buffer.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is no parameter.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Initial values, each parameter's as it was declared. Parameters that draw nothing leave the generator alone.
    pub fn initial(&self, rng: &mut impl Rng) -> Vec<f32> {
        let mut values = vec![0.0; self.len];
        for param in &self.params {
            let values = &mut values[param.range.clone()];
            match param.initial {
                Initial::Uniform(bound) => {
                    values.fill_with(|| rng.random_range(-bound..=bound));
                }
                Initial::Zeros => {}
                Initial::Ones => values.fill(1.0),
                Initial::Orthogonal(gain) => orthogonal(values, param.shape[0], gain, rng),
            }
        }
        values
    }
}

/// Collects parameters while layers declare themselves.
#[derive(Debug, Default)]
pub struct LayoutBuilder {
    layout: Layout,
}

impl LayoutBuilder {
    /// Adds a parameter after those declared so far, uniform in ± `bound` at first: PyTorch's 1/√fan_in for linear
    /// layers, 1/√h for a GRU.
    pub fn add(&mut self, name: impl Into<String>, shape: &[usize], bound: f32) -> Range<usize> {
        self.add_as(name, shape, Initial::Uniform(bound))
    }

    /// Adds a parameter after those declared so far.
    pub fn add_as(&mut self, name: impl Into<String>, shape: &[usize], initial: Initial) -> Range<usize> {
        let start = self.layout.len;
        self.layout.len += shape.iter().product::<usize>();
        let range = start..self.layout.len;
        self.layout.params.push(Param {
            name: name.into(),
            shape: shape.to_vec(),
            range: range.clone(),
            initial,
        });
        range
    }

    /// Declares layers whose weights begin orthogonal with this gain and whose biases begin at 0.
    pub fn orthogonal<T>(&mut self, gain: f32, declare: impl FnOnce(&mut Self) -> T) -> T {
        let first = self.layout.params.len();
        let declared = declare(self);
        for param in &mut self.layout.params[first..] {
            param.initial = if param.shape.len() > 1 { Initial::Orthogonal(gain) } else { Initial::Zeros };
        }
        declared
    }

    /// The derived layers, to declare more; see [`Layout::of`].
    pub fn derived(&mut self) -> &mut Derived {
        &mut self.layout.derived
    }

    /// Numbers declared so far: where the next parameter will begin.
    pub fn len(&self) -> usize {
        self.layout.len
    }

    /// Whether nothing is declared yet.
    pub fn is_empty(&self) -> bool {
        self.layout.is_empty()
    }

    /// The whole layout.
    pub fn finish(self) -> Layout {
        self.layout
    }
}

/// Fills a matrix of `rows` rows: Q of the QR decomposition of a standard normal matrix, its longer side first, with
/// a positive diagonal of R; times `gain`.
fn orthogonal(matrix: &mut [f32], rows: usize, gain: f32, rng: &mut impl Rng) {
    let cols = matrix.len() / rows.max(1);
    let (long, short) = (rows.max(cols), rows.min(cols));
    // Drawn row by row, kept by columns. Gram-Schmidt gives the decomposition with a positive diagonal; done twice, its
    // columns are orthogonal to the precision of f64.
    let mut columns = vec![vec![0.0_f64; long]; short];
    for at in 0..long {
        columns.iter_mut().for_each(|column| column[at] = standard_normal(rng));
    }
    for column in 0..short {
        let (before, rest) = columns.split_at_mut(column);
        let column = &mut rest[0];
        for _ in 0..2 {
            for other in &*before {
                let along: f64 = other.iter().zip(&*column).map(|(a, b)| a * b).sum();
                column.iter_mut().zip(other).for_each(|(x, other)| *x -= along * other);
            }
        }
        let norm = column.iter().map(|x| x * x).sum::<f64>().sqrt();
        column.iter_mut().for_each(|x| *x /= norm);
    }
    for (at, value) in matrix.iter_mut().enumerate() {
        let (row, col) = (at / cols, at % cols);
        let q = if rows >= cols { columns[col][row] } else { columns[row][col] };
        *value = (f64::from(gain) * q) as f32;
    }
}

/// A standard normal number (Box and Muller), the same on every machine.
fn standard_normal(rng: &mut impl Rng) -> f64 {
    // In (0, 1]: its logarithm is finite.
    let u = 1.0 - rng.random::<f64>();
    let angle = std::f64::consts::TAU * rng.random::<f64>();
    (-2.0 * libm::log(u)).sqrt() * libm::cos(angle)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn standard_normal_numbers_have_mean_zero_and_variance_one() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let draws: Vec<f64> = (0..100_000).map(|_| standard_normal(&mut rng)).collect();
        let moment = |power| draws.iter().map(|x| x.powi(power)).sum::<f64>() / 1e5;
        // Standard deviations of the estimates: 0.003, 0.0045, 0.03.
        assert!(moment(1).abs() < 0.015 && (moment(2) - 1.0).abs() < 0.02 && (moment(4) - 3.0).abs() < 0.15);
    }

    #[test]
    fn orthogonal_matrices_have_orthonormal_rows_or_columns_times_the_gain() {
        for (rows, cols) in [(6, 4), (4, 6), (5, 5), (1, 7), (192, 64)] {
            let mut matrix = vec![0.0; rows * cols];
            orthogonal(&mut matrix, rows, 0.5, &mut ChaCha8Rng::seed_from_u64(3));
            let at = |row: usize, col: usize| f64::from(matrix[row * cols + col]);
            let short = rows.min(cols);
            for a in 0..short {
                for b in 0..short {
                    let dot: f64 = if rows >= cols {
                        (0..rows).map(|row| at(row, a) * at(row, b)).sum()
                    } else {
                        (0..cols).map(|col| at(a, col) * at(b, col)).sum()
                    };
                    let expected = if a == b { 0.25 } else { 0.0 };
                    assert!((dot - expected).abs() < 1e-6, "{rows} {cols}: {a} {b} {dot}");
                }
            }
        }
    }

    #[test]
    fn every_parameter_begins_as_declared() {
        let mut layout = LayoutBuilder::default();
        layout.add("uniform", &[50], 0.25);
        layout.add_as("ones", &[2], Initial::Ones);
        layout.orthogonal(2.0, |layout| {
            layout.add("weight", &[1, 4], 9.0);
            layout.add("bias", &[1], 9.0);
        });
        let layout = layout.finish();
        let values = layout.initial(&mut ChaCha8Rng::seed_from_u64(5));
        assert!(values[..50].iter().all(|x| x.abs() <= 0.25) && values[..50].iter().any(|x| x.abs() > 0.2));
        assert_eq!(values[50..52], [1.0, 1.0]);
        let norm: f32 = values[52..56].iter().map(|x| x * x).sum();
        assert!((norm - 4.0).abs() < 1e-5);
        assert_eq!(values[56], 0.0);
    }
}
