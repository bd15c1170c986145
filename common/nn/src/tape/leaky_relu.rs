//! LeakyReLU on the tape.

use super::{Tape, Var};
use crate::{ViewMut, activation, linear};

impl Tape<'_> {
    /// y = LeakyReLU(x). `x` (rows, columns), y likewise.
    pub fn leaky_relu(&mut self, x: Var) -> Var {
        let mut y = self.take(x.len());
        let mut view = ViewMut::dense(&mut y, x.cols);
        linear::copy(view.reborrow(), self.view(x));
        activation::leaky_relu(view);
        let y = self.push(y, x.cols);
        self.record(move |back| {
            let Some(mut dy) = back.gradients.take(y) else { return };
            activation::leaky_relu_backward(back.values.view(y), dy.view_mut());
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
        check_operation(0, &[(3, 7)], |tape, x| tape.leaky_relu(x[0].columns(1..6)));
    }
}
