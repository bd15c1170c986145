//! Normal distributions on the tape: their variances, and samples of them.

use super::{Tape, Var};
use crate::{Accum, View, ViewMut, math, vectorized};

impl<'a> Tape<'a> {
    /// y = max(e^x, `floor`): a variance from what a layer makes. Nothing passes at the floor. `x` (rows, columns), y
    /// likewise.
    pub fn variance(&mut self, x: Var, floor: f32) -> Var {
        let mut y = self.take(x.len());
        exponentials(self.view(x), ViewMut::dense(&mut y, x.cols), floor);
        let y = self.push(y, x.cols);
        self.record(move |back| {
            let Some(dy) = back.gradients.take(y) else { return };
            back.accumulate(x, |_, values, mut dx| {
                let (of_y, dy) = (values.view(y), dy.view());
                for row in 0..dy.rows {
                    for ((dx, y), dy) in dx.row(row).iter_mut().zip(of_y.row(row)).zip(dy.row(row)) {
                        *dx = if *y > floor { dy * y } else { 0.0 };
                    }
                }
            });
            back.gradients.done(dy);
        });
        y
    }

    /// y = mean + √variance ⊙ `noise`: a sample, where noise is standard normal. All (rows, columns).
    pub fn sample(&mut self, mean: Var, variance: Var, noise: View<'a>) -> Var {
        let mut y = self.take(mean.len());
        let (m, v) = (self.view(mean), self.view(variance));
        for (row, y) in y.chunks_exact_mut(mean.cols).enumerate() {
            let parts = m.row(row).iter().zip(v.row(row)).zip(noise.row(row));
            for (y, ((m, v), noise)) in y.iter_mut().zip(parts) {
                *y = v.sqrt().mul_add(*noise, *m);
            }
        }
        let y = self.push(y, mean.cols);
        self.record(move |back| {
            let Some(dy) = back.gradients.take(y) else { return };
            if let Some(mut d) = back.gradients.begin(mean) {
                d.add(dy.view());
                back.gradients.end(d);
            }
            if let Some(mut d) = back.gradients.begin(variance) {
                let (accum, mut to) = (d.accum, d.view_mut());
                let (of_variance, dy) = (back.values.view(variance), dy.view());
                for row in 0..dy.rows {
                    let parts = of_variance.row(row).iter().zip(dy.row(row)).zip(noise.row(row));
                    for (d, ((v, dy), noise)) in to.row(row).iter_mut().zip(parts) {
                        let by = 0.5 * dy * noise / v.sqrt();
                        *d = if accum == Accum::Add { *d + by } else { by };
                    }
                }
                back.gradients.end(d);
            }
            back.gradients.done(dy);
        });
        y
    }
}

vectorized! {
    /// y = max(e^x, floor).
    fn exponentials<'a>(x: View<'a>, y: ViewMut<'a>, floor: f32) {
        for row in 0..x.rows {
            for (y, x) in y.row(row).iter_mut().zip(x.row(row)) {
                *y = math::exp(*x).max(floor);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::{
        View,
        gradcheck::{check_operation, noise, run_operation},
    };

    #[test]
    fn variances_and_samples_by_hand() {
        let out = run_operation(&[], &[(&[0.0, 1.0, -5.0, -2.0], 2)], |tape, x| tape.variance(x[0], 0.1));
        let expected = [1.0, std::f32::consts::E, 0.1, 0.135_335_28];
        assert!(out.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{out:?}");
        let inputs: [(&[f32], usize); 2] = [(&[1.0, 2.0], 2), (&[4.0, 0.25], 2)];
        let out =
            run_operation(&[], &inputs, |tape, x| tape.sample(x[0], x[1], View::dense(&[3.0, -2.0], 2)));
        assert_eq!(out, [7.0, 1.0]);
    }

    #[test]
    fn gradients_are_the_numeric_ones() {
        let drawn = noise(7, 3 * 2);
        check_operation(0, &[(3, 4)], |tape, x| {
            let variance = tape.variance(x[0].columns(2..4), 0.9);
            tape.sample(x[0].columns(0..2), variance, View::dense(&drawn, 2))
        });
    }
}
