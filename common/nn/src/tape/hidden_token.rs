//! UPDeT's block on the tape.

use super::{Tape, Var};
use crate::{HiddenToken, ViewMut, hidden_token::Places};

impl<'a> Tape<'a> {
    /// What becomes of the agents' own tokens, (R, h), and of their hidden tokens, (R, h), which want no gradient; see
    /// [`HiddenToken::forward`]. `x` (E, h) is every entity's. `before` (rows of the first time, h) are the hidden tokens
    /// before the first time, or zeros; no gradient goes there.
    pub fn hidden_token(
        &mut self,
        block: &HiddenToken,
        x: Var,
        places: Places<'a>,
        before: Option<Var>,
    ) -> (Var, Var) {
        let h = block.dim();
        let len = places.rows() * h;
        let (mut own, mut history) = (self.take(len), self.take(len));
        let before = before.map(|before| self.values.view(before));
        let view = self.values.view(x);
        let state = block.forward(self.params, places, view, before, &mut own, &mut history, &mut self.stock);
        let history = self.push_detached(history, h);
        let own = self.push(own, h);
        if self.is_recording() {
            let block = block.clone();
            self.record(move |back| {
                if let Some(d_own) = back.gradients.take(own) {
                    let mut d_x = back.gradients.work.take(x.len());
                    block.backward(
                        back.params,
                        places,
                        back.values.view(x),
                        &state,
                        d_own.view(),
                        ViewMut::dense(&mut d_x, x.cols),
                        back.grads,
                        &mut back.gradients.work,
                    );
                    back.gradients.contribute(x, d_x);
                    back.gradients.done(d_own);
                }
                state.give(&mut back.stock);
            });
        } else {
            state.give(&mut self.stock);
        }
        (own, history)
    }
}

#[cfg(test)]
mod tests {
    use crate::{
        HiddenToken, LayoutBuilder,
        attention::{Group, Visible},
        gradcheck::check_operation,
        hidden_token::Places,
    };

    /// One agent among two entities, three times.
    #[test]
    fn gradients_are_the_numeric_ones() {
        let mut layout = LayoutBuilder::default();
        let block = HiddenToken::new(&mut layout, "block", 3, 4, 2, 5);
        let groups: Vec<Group> =
            (0..3).map(|time| Group { queries: time..time + 1, keys: 2 * time..2 * time + 2 }).collect();
        let seen = [1, 1, 0, 0, 1, 0];
        check_operation(layout.len(), &[(6, 3)], |tape, x| {
            let places = Places {
                groups: &groups,
                group_times: &[0, 1, 2, 3],
                agent_times: &[0, 1, 2, 3],
                visible: Visible::Where(&seen),
            };
            tape.hidden_token(&block, x[0], places, None).0
        });
    }
}
