//! Grouped attention on the tape, in its three parts: methods that look at the same entities through several masks make
//! queries, keys and values once.

use super::{Tape, Var};
use crate::{
    Accum, Attention, ViewMut,
    attention::{self, Group, Visible},
    linear, matmul,
};

impl<'a> Tape<'a> {
    /// Keys (without their bias, which no softmax sees) and values of all rows, side by side. `x` (K, h), y (K, 2a).
    pub fn key_values(&mut self, attention: &Attention, x: Var) -> Var {
        let a = attention.dim;
        let mut y = self.take(x.rows * 2 * a);
        attention.project_keys(self.params, self.view(x), ViewMut::dense(&mut y, 2 * a));
        let y = self.push(y, 2 * a);
        let layer = attention.key_value.clone();
        self.record(move |back| {
            // ReLU's slope is in it already: whoever attends sees to that.
            let Some(dy) = back.gradients.take(y) else { return };
            linear::add_column_sums(dy.view().columns(a..2 * a), &mut layer.bias_mut(back.grads)[a..]);
            matmul::dyt_x(dy.view(), back.values.view(x), layer.weight_mut(back.grads), Accum::Add);
            if let Some(mut dx) = back.gradients.begin(x) {
                let accum = dx.accum;
                matmul::dy_w(dy.view(), layer.weight(back.params), dx.view_mut(), accum);
                back.gradients.end(dx);
            }
            back.gradients.done(dy);
        });
        y
    }

    /// What each query sees, (Q, a). `queries` (Q, a): [`Tape::linear`] of [`Attention::query`]; `key_values` (K, 2a):
    /// [`Tape::key_values`].
    pub fn attend(
        &mut self,
        attention: &Attention,
        queries: Var,
        key_values: Var,
        groups: &'a [Group],
        visible: Visible<'a>,
    ) -> Var {
        let out = self.reserve(queries.rows, attention.dim);
        self.attend_into(attention, queries, key_values, groups, &[visible], out);
        out
    }

    /// As [`Tape::attend`], under M masks, row `q M + i` being query q's under mask i, and into columns (Q M, a) of a
    /// matrix that was [reserved](Tape::reserve).
    pub fn attend_into(
        &mut self,
        attention: &Attention,
        queries: Var,
        key_values: Var,
        groups: &'a [Group],
        masks: &[Visible<'a>],
        out: Var,
    ) {
        let mut weights = self.take(attention::weights_len(groups, masks.len(), attention.heads));
        self.write_into(out, |values, out, _| {
            let (queries, key_values) = (values.view(queries), values.slice(key_values));
            attention.attend_views(queries, key_values, groups, masks, &mut weights, out);
        });
        if !self.is_recording() {
            return self.give(weights);
        }
        let attention = attention.clone();
        self.record(move |back| {
            let Some(d_out) = back.gradients.take(out) else { return back.stock.give(weights) };
            // Every query and every key belongs to one group, so all of these are written.
            let mut d_queries = back.gradients.work.take(queries.len());
            let mut d_key_values = back.gradients.work.take(key_values.len());
            let d = (&mut d_queries[..], &mut d_key_values[..]);
            let (of_queries, of_keys) = (back.values.view(queries), back.values.slice(key_values));
            attention.attend_views_backward(of_queries, of_keys, groups, &weights, d_out.view(), d);
            back.gradients.contribute(queries, d_queries);
            back.gradients.contribute(key_values, d_key_values);
            back.gradients.done(d_out);
            back.stock.give(weights);
        });
    }
}

#[cfg(test)]
mod tests {
    use crate::{
        Attention, LayoutBuilder,
        attention::{Group, Visible},
        gradcheck::check_operation,
    };

    /// Two passes over the same entities through different masks, as REFIL makes them; the second group's query sees
    /// nothing in the first.
    #[test]
    fn gradients_are_the_numeric_ones() {
        let mut layout = LayoutBuilder::default();
        let attention = Attention::new(&mut layout, "attention", 3, 4, 2);
        let groups = [Group { queries: 0..2, keys: 0..3 }, Group { queries: 2..3, keys: 3..5 }];
        let masks = [[1, 0, 1, 1, 1, 1, 0, 0], [0, 1, 1, 1, 0, 1, 1, 1]];
        check_operation(layout.len(), &[(3, 3), (5, 3)], |tape, x| {
            let queries = tape.linear(&attention.query, x[0]);
            let key_values = tape.key_values(&attention, x[1]);
            let both = tape.reserve(3, 8);
            for (mask, columns) in masks.iter().zip([0..4, 4..8]) {
                let visible = Visible::Where(mask);
                let out = both.columns(columns);
                tape.attend_into(&attention, queries, key_values, &groups, &[visible], out);
            }
            both
        });
        let all = [Visible::Where(&masks[0]), Visible::All, Visible::Where(&masks[1])];
        check_operation(layout.len(), &[(3, 3), (5, 3)], |tape, x| {
            let queries = tape.linear(&attention.query, x[0]);
            let key_values = tape.key_values(&attention, x[1]);
            let out = tape.reserve(3 * all.len(), 4);
            tape.attend_into(&attention, queries, key_values, &groups, &all, out);
            out
        });
    }
}
