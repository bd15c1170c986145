//! Sums on the tape: a residual connection.

use super::{Tape, Var};
use crate::{ViewMut, linear};

impl Tape<'_> {
    /// y = x + z. All (rows, columns).
    pub fn add(&mut self, x: Var, z: Var) -> Var {
        debug_assert_eq!((x.rows, x.cols), (z.rows, z.cols));
        let mut y = self.take(x.len());
        let mut view = ViewMut::dense(&mut y, x.cols);
        linear::copy(view.reborrow(), self.view(x));
        linear::add(view, self.view(z));
        let y = self.push(y, x.cols);
        self.record(move |back| {
            let Some(dy) = back.gradients.take(y) else { return };
            for term in [x, z] {
                if let Some(mut d) = back.gradients.begin(term) {
                    d.add(dy.view());
                    back.gradients.end(d);
                }
            }
            back.gradients.done(dy);
        });
        y
    }
}

#[cfg(test)]
mod tests {
    use crate::gradcheck::{check_operation, run_operation};

    #[test]
    fn a_sum_by_hand() {
        let (x, z) = ([1.0, 2.0, 3.0, 4.0], [10.0, 20.0, 30.0, 40.0]);
        let out = run_operation(&[], &[(&x, 2), (&z, 2)], |tape, x| tape.add(x[0], x[1]));
        assert_eq!(out, [11.0, 22.0, 33.0, 44.0]);
    }

    #[test]
    fn gradients_are_the_numeric_ones() {
        check_operation(0, &[(3, 4), (3, 2)], |tape, x| tape.add(x[0].columns(1..3), x[1]));
        check_operation(0, &[(3, 2)], |tape, x| tape.add(x[0], x[0]));
    }
}
