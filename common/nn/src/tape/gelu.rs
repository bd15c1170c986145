//! GELU on the tape.

use super::{Tape, Var};
use crate::{ViewMut, activation};

impl Tape<'_> {
    /// y = GELU(x), exact. `x` (rows, columns), y likewise.
    pub fn gelu(&mut self, x: Var) -> Var {
        let mut y = self.take(x.len());
        activation::gelu(self.view(x), ViewMut::dense(&mut y, x.cols));
        let y = self.push(y, x.cols);
        self.record(move |back| {
            let Some(mut dy) = back.gradients.take(y) else { return };
            activation::gelu_backward(back.values.view(x), dy.view_mut());
            if let Some(mut dx) = back.gradients.begin(x) {
                dx.add(dy.view());
                back.gradients.end(dx);
            }
            back.gradients.done(dy);
        });
        y
    }
}

#[cfg(test)]
mod tests {
    use crate::gradcheck::check_operation;

    #[test]
    fn gradients_are_the_numeric_ones() {
        check_operation(0, &[(3, 7)], |tape, x| tape.gelu(x[0].columns(1..6)));
    }
}
