//! Values that are read and pass no gradient.

use super::{Tape, Var};
use crate::{ViewMut, linear};

impl Tape<'_> {
    /// The same numbers, through which no gradient passes.
    pub fn detach(&mut self, x: Var) -> Var {
        let mut y = self.take(x.len());
        linear::copy(ViewMut::dense(&mut y, x.cols), self.view(x));
        self.push_detached(y, x.cols)
    }

    /// Each row's predecessor: the row of the same place at the time before, zeros at the first. No gradient passes.
    /// `times[t]` is the first row of time t, its last element how many rows there are.
    pub fn detached_predecessors(&mut self, x: Var, times: &[usize]) -> Var {
        let mut y = self.take(x.len());
        let (view, cols) = (self.view(x), x.cols);
        for (time, rows) in times.windows(2).enumerate() {
            for row in rows[0]..rows[1] {
                let to = &mut y[row * cols..][..cols];
                match time {
                    0 => to.fill(0.0),
                    _ => to.copy_from_slice(view.row(times[time - 1] + row - rows[0])),
                }
            }
        }
        self.push_detached(y, cols)
    }
}

#[cfg(test)]
mod tests {
    use crate::{
        View,
        gradcheck::run_operation,
        tape::{Stock, Tape},
    };

    /// Three sequences of lengths 3, 2 and 1.
    #[test]
    fn predecessors_by_hand() {
        let x = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let out = run_operation(&[], &[(&x, 1)], |tape, x| tape.detached_predecessors(x[0], &[0, 3, 5, 6]));
        assert_eq!(out, [0.0, 0.0, 0.0, 1.0, 2.0, 4.0]);
    }

    #[test]
    fn what_is_detached_passes_no_gradient() {
        let x = [1.0, 2.0];
        let mut tape = Tape::recording(&[], Stock::default());
        let x = tape.input(View::dense(&x, 1));
        let (y, before) = (tape.detach(x), tape.detached_predecessors(x, &[0, 1, 2]));
        assert_eq!((tape.slice(y), tape.slice(before)), (&[1.0, 2.0][..], &[0.0, 1.0][..]));
        for (var, d) in [(y, [5.0, 7.0]), (before, [5.0, 7.0]), (x, [3.0, 4.0])] {
            tape.seed(var, View::dense(&d, 1));
        }
        tape.backward(&mut []);
        assert_eq!(tape.gradient(x).data, [3.0, 4.0]);
    }
}
