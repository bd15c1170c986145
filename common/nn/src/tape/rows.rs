//! Rows picked out of a matrix, and one number picked out of each row.

use super::{Tape, Var};
use crate::{View, ViewMut, math, vectorized};

impl<'a> Tape<'a> {
    /// y row i = x row `rows[i]`. `x` (R, c), y (rows, c).
    pub fn gather(&mut self, x: Var, rows: &'a [usize]) -> Var {
        let y = self.take(rows.len() * x.cols);
        let y = self.push(y, x.cols);
        self.gather_into(x, rows, y);
        y
    }

    /// As [`Tape::gather`], into columns of a matrix that was [reserved](Tape::reserve).
    pub fn gather_into(&mut self, x: Var, rows: &'a [usize], y: Var) {
        self.write_into(y, |values, y, _| gather(values.view(x), rows, y));
        self.record(move |back| {
            let Some(dy) = back.gradients.take(y) else { return };
            if let Some(mut dx) = back.gradients.begin_adding(x) {
                scatter(dy.view(), rows, dx.view_mut());
                back.gradients.end(dx);
            }
            back.gradients.done(dy);
        });
    }

    /// Each row's number at its index: the utility of the action taken. `x` (R, c), `indices` (R), y (R, 1).
    pub fn choose(&mut self, x: Var, indices: &[u8]) -> Var {
        let mut y = self.take(x.rows);
        for ((row, &index), y) in indices.iter().enumerate().zip(y.iter_mut()) {
            *y = self.view(x).row(row)[usize::from(index)];
        }
        let y = self.push(y, 1);
        if self.is_recording() {
            let indices = indices.to_vec();
            self.record(move |back| {
                let Some(dy) = back.gradients.take(y) else { return };
                if let Some(mut dx) = back.gradients.begin_adding(x) {
                    let (mut to, from) = (dx.view_mut(), dy.view());
                    for (row, &index) in indices.iter().enumerate() {
                        to.row(row)[usize::from(index)] += from.row(row)[0];
                    }
                    back.gradients.end(dx);
                }
                back.gradients.done(dy);
            });
        }
        y
    }
}

vectorized! {
    fn gather<'a>(x: View<'a>, rows: &'a [usize], y: ViewMut<'a>) {
        for (to, &from) in rows.iter().enumerate() {
            y.row(to).copy_from_slice(x.row(from));
        }
    }
}

vectorized! {
    /// dx row `rows[i]` += dy row i.
    fn scatter<'a>(dy: View<'a>, rows: &'a [usize], dx: ViewMut<'a>) {
        for (from, &to) in rows.iter().enumerate() {
            math::add_scaled(dx.row(to), 1.0, dy.row(from));
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::gradcheck::{check_operation, run_operation};

    #[test]
    fn rows_and_numbers_by_hand() {
        let x = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let out = run_operation(&[], &[(&x, 2)], |tape, x| tape.gather(x[0], &[2, 0, 2, 1]));
        assert_eq!(out, [5.0, 6.0, 1.0, 2.0, 5.0, 6.0, 3.0, 4.0]);
        let out = run_operation(&[], &[(&x, 2)], |tape, x| tape.choose(x[0], &[1, 0, 1]));
        assert_eq!(out, [2.0, 3.0, 6.0]);
    }

    #[test]
    fn gradients_are_the_numeric_ones() {
        check_operation(0, &[(3, 4)], |tape, x| tape.gather(x[0].columns(1..3), &[2, 0, 2]));
        check_operation(0, &[(3, 4)], |tape, x| tape.choose(x[0], &[3, 0, 3]));
    }
}
