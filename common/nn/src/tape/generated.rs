//! A generated linear layer on the tape.

use super::{Tape, Var};
use crate::{Generated, ViewMut};

impl Tape<'_> {
    /// See [`Generated::forward`]. `x` (rows, inputs), `c` (rows, r), y (rows, outputs).
    pub fn generated(&mut self, layer: &Generated, x: Var, c: Var) -> Var {
        let (outputs, width) = (layer.outputs(), layer.outputs() * layer.codes());
        let (mut mixed, mut y) = (self.take(x.rows * width), self.take(x.rows * outputs));
        let (to_mixed, to_y) = (ViewMut::dense(&mut mixed, width), ViewMut::dense(&mut y, outputs));
        layer.forward(self.params, self.view(x), self.view(c), to_mixed, to_y);
        let y = self.push(y, outputs);
        if !self.is_recording() {
            self.give(mixed);
            return y;
        }
        let layer = layer.clone();
        self.record(move |back| {
            if let Some(dy) = back.gradients.take(y) {
                let work = &mut back.gradients.work;
                let (mut dx, mut dc) = (work.take(x.len()), work.take(c.len()));
                layer.backward(
                    back.params,
                    back.values.view(x),
                    back.values.view(c),
                    ViewMut::dense(&mut mixed, width),
                    dy.view(),
                    ViewMut::dense(&mut dx, x.cols),
                    ViewMut::dense(&mut dc, c.cols),
                    back.grads,
                );
                back.gradients.contribute(x, dx);
                back.gradients.contribute(c, dc);
                back.gradients.done(dy);
            }
            back.stock.give(mixed);
        });
        y
    }
}

#[cfg(test)]
mod tests {
    use crate::{Generated, LayoutBuilder, Linear, gradcheck::check_operation};

    #[test]
    fn gradients_are_the_numeric_ones() {
        let mut layout = LayoutBuilder::default();
        let weight = Linear::new(&mut layout, "weight", 3, 4 * 2);
        let layer = Generated::new(weight, Linear::new(&mut layout, "bias", 3, 2));
        check_operation(layout.len(), &[(5, 4), (5, 4)], |tape, x| {
            tape.generated(&layer, x[0], x[1].columns(1..4))
        });
    }
}
