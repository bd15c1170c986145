//! Layer normalisation on the tape.

use super::{Tape, Var};
use crate::{LayerNorm, ViewMut};

impl Tape<'_> {
    /// See [`LayerNorm::forward`]. `x` (rows, dim), y (rows, dim).
    pub fn layer_norm(&mut self, norm: &LayerNorm, x: Var) -> Var {
        let (mut y, mut moments) = (self.take(x.len()), self.take(2 * x.rows));
        norm.forward(self.params, self.view(x), ViewMut::dense(&mut y, x.cols), &mut moments);
        let y = self.push(y, x.cols);
        if self.is_recording() {
            let norm = norm.clone();
            self.record(move |back| {
                if let Some(dy) = back.gradients.take(y) {
                    let of_x = back.values.view(x);
                    norm.backward_params(of_x, &moments, dy.view(), back.grads);
                    back.accumulate(x, |params, values, dx| {
                        norm.backward_input(params, values.view(x), &moments, dy.view(), dx);
                    });
                    back.gradients.done(dy);
                }
                back.stock.give(moments);
            });
        } else {
            self.give(moments);
        }
        y
    }
}

#[cfg(test)]
mod tests {
    use crate::{LayerNorm, LayoutBuilder, gradcheck::check_operation};

    #[test]
    fn gradients_are_the_numeric_ones() {
        let mut layout = LayoutBuilder::default();
        let norm = LayerNorm::new(&mut layout, "norm", 5);
        check_operation(layout.len(), &[(3, 7)], |tape, x| tape.layer_norm(&norm, x[0].columns(1..6)));
        // Where a gradient is there already.
        check_operation(layout.len(), &[(3, 5)], |tape, x| {
            let y = tape.layer_norm(&norm, x[0]);
            tape.add(y, x[0])
        });
    }
}
