//! The recurrent unit on the tape.

use super::{Tape, Var};
use crate::{Gru, gru::GruState};

impl<'a> Tape<'a> {
    /// The hidden state after each row, (R, h), over rows in time order; see [`Gru::forward`]. `gates` (R, 3h) is the
    /// input's share of the gates without its bias: [`Tape::product_of`] over [`Gru::input`]. It is used up. `before`
    /// (rows of time 0, h) is the state before the first time, or zeros; no gradient goes there.
    pub fn gru(&mut self, unit: &Gru, gates: Var, times: &'a [usize], before: Option<Var>) -> Var {
        let mut state = GruState {
            gates: self.consume(gates),
            new_from_hidden: self.take(gates.rows * unit.hidden_dim),
            history: self.take(gates.rows * unit.hidden_dim),
        };
        let before = before.map(|before| self.values.view(before));
        unit.forward(self.params, times, before, &mut state, &mut self.gradients.work);
        let history = self.push(std::mem::take(&mut state.history), unit.hidden_dim);
        if self.is_recording() {
            let unit = unit.clone();
            self.record(move |back| {
                let Some(mut d_history) = back.gradients.take(history) else { return };
                let work = &mut back.gradients.work;
                let of_history = back.values.slice(history);
                let d = d_history.view_mut().data;
                let left = (&mut state.gates[..], &state.new_from_hidden[..]);
                unit.backward(back.params, times, left, of_history, d, back.grads, work);
                back.gradients.done(d_history);
                back.stock.give(state.new_from_hidden);
                back.gradients.put(gates, state.gates, &mut back.stock);
            });
        } else {
            self.give(state.gates);
            self.give(state.new_from_hidden);
        }
        history
    }
}

#[cfg(test)]
mod tests {
    use crate::{Gru, LayoutBuilder, gradcheck::check_operation};

    /// Three sequences of lengths 3, 2 and 1.
    const TIMES: [usize; 4] = [0, 3, 5, 6];

    #[test]
    fn gradients_are_the_numeric_ones() {
        let mut layout = LayoutBuilder::default();
        let gru = Gru::new(&mut layout, "gru", 5, 4);
        check_operation(layout.len(), &[(6, 2), (6, 3)], |tape, x| {
            let gates = tape.product_of(&gru.input, 0, &[x[0], x[1]]);
            tape.gru(&gru, gates, &TIMES, None)
        });
    }
}
