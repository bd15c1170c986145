//! Grouped attention on the tape, in its three parts: methods that look at the same entities through several masks make
//! queries, keys and values once.

use super::{Backward, Gradient, Gradients, Tape, Values, Var};
use crate::{
    Accum, Attention, Buffer, ViewMut,
    attention::{self, Group, KeysMut, Sides, SidesMut, Visible},
    linear, matmul,
};

impl<'a> Tape<'a> {
    /// Keys (without their bias, which no softmax sees) and values of all rows, side by side. `x` (K, h), y (K, 2a).
    pub fn key_values(&mut self, attention: &Attention, x: Var) -> Var {
        let a = attention.dim;
        let mut y = self.take(x.rows * 2 * a);
        attention.project_keys(self.params, self.view(x), ViewMut::dense(&mut y, 2 * a));
        let y = self.push(y, 2 * a);
        let attention = attention.clone();
        self.record(move |back| {
            let Some(mut dy) = back.gradients.take(y) else { return };
            let layer = &attention.key_value;
            attention.rectify_backward(back.values.view(y), dy.view_mut());
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
        let a = attention.dim;
        let (keys, values) = (key_values.columns(0..a), key_values.columns(a..2 * a));
        let (heads, head_dim) = (attention.heads, attention.head_dim());
        self.attend_over(Over { queries, keys, values, rows: None, heads, head_dim }, groups, masks, out);
    }

    /// As [`Tape::attend_into`], of any queries, keys and values.
    pub fn attend_over(&mut self, over: Over<'a>, groups: &'a [Group], masks: &[Visible<'a>], out: Var) {
        let mut weights = self.take(attention::weights_len(groups, masks.len(), over.heads));
        self.write_into(out, |values, out, _| {
            attention::forward(over.sides(values), groups, masks, &mut weights, out);
        });
        if !self.is_recording() {
            return self.give(weights);
        }
        self.record(move |back| {
            let Some(d_out) = back.gradients.take(out) else { return back.stock.give(weights) };
            over.backward(back, groups, &weights, &d_out);
            back.gradients.done(d_out);
            back.stock.give(weights);
        });
    }
}

/// What attention is made of on the tape: see [`attention::Sides`].
#[derive(Clone, Copy, Debug)]
pub struct Over<'a> {
    /// (Q, H k).
    pub queries: Var,
    /// (K, H k), or (K, k) where all heads look at the same keys.
    pub keys: Var,
    /// (K, a).
    pub values: Var,
    /// Which row of keys and values each of the groups' keys stands for, if several may stand for one.
    pub rows: Option<&'a [usize]>,
    /// H.
    pub heads: usize,
    /// Width of one head's values, a / H: scores are divided by its square root.
    pub head_dim: usize,
}

impl Over<'_> {
    fn sides<'v>(&'v self, values: &'v Values<'_>) -> Sides<'v> {
        Sides {
            queries: values.view(self.queries),
            keys: values.view(self.keys),
            values: values.view(self.values),
            rows: self.rows,
            heads: self.heads,
            scale: attention::scale(self.head_dim),
        }
    }

    /// Contributes to the gradients by all three.
    fn backward(&self, back: &mut Backward<'_>, groups: &[Group], weights: &[f32], d_out: &Gradient) {
        let mut d_queries = back.gradients.work.take(self.queries.len());
        let queries = ViewMut::dense(&mut d_queries, self.queries.cols);
        let (sides, gradients) = (self.sides(&back.values), &mut back.gradients);
        match self.keys.beside(self.values) {
            Some(both) => {
                let mut d = Contribution::begin(gradients, both, self.rows.is_some());
                let adds = [d.adds(); 2];
                let keys = KeysMut::Together(d.view_mut());
                attention::backward(sides, groups, weights, d_out.view(), SidesMut { queries, keys, adds });
                d.end(gradients);
            }
            None => {
                let [mut d_keys, mut d_values] = [self.keys, self.values]
                    .map(|side| Contribution::begin(gradients, side, self.rows.is_some()));
                let adds = [d_keys.adds(), d_values.adds()];
                let keys = KeysMut::Apart(d_keys.view_mut(), d_values.view_mut());
                attention::backward(sides, groups, weights, d_out.view(), SidesMut { queries, keys, adds });
                d_keys.end(gradients);
                d_values.end(gradients);
            }
        }
        back.gradients.contribute(self.queries, d_queries);
    }
}

/// Where the kernel writes the gradient by keys or values, which it makes together with that by the queries.
enum Contribution {
    /// To the gradient.
    Wanted(Gradient),
    /// Where keys or values are constant, to memory that is not read.
    Unwanted {
        /// Dense.
        buffer: Buffer,
        /// Its columns.
        cols: usize,
    },
}

impl Contribution {
    /// Begins one; `shared` where several keys stand for one row: none of them may then write over the others.
    fn begin(gradients: &mut Gradients, x: Var, shared: bool) -> Self {
        let begun = if shared { gradients.begin_adding(x) } else { gradients.begin(x) };
        begun.map_or_else(
            || Self::Unwanted { buffer: gradients.work.take_zeros(x.len()), cols: x.cols },
            Self::Wanted,
        )
    }

    fn adds(&self) -> bool {
        match self {
            Self::Wanted(gradient) => gradient.accum == Accum::Add,
            Self::Unwanted { .. } => true,
        }
    }

    fn view_mut(&mut self) -> ViewMut<'_> {
        match self {
            Self::Wanted(gradient) => gradient.view_mut(),
            Self::Unwanted { buffer, cols } => ViewMut::dense(buffer, *cols),
        }
    }

    fn end(self, gradients: &mut Gradients) {
        match self {
            Self::Wanted(gradient) => gradients.end(gradient),
            Self::Unwanted { buffer, .. } => gradients.work.give(buffer),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Over;
    use crate::{
        Attention, LayoutBuilder, Linear, Tape, Var, View,
        attention::{Group, Visible},
        gradcheck::{check_operation, noise, run_operation},
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

    /// Queries learn from keys and values that are constant, both or one of them, side by side or apart.
    #[test]
    fn constant_keys_and_values_pass_the_queries_gradient() {
        let mut layout = LayoutBuilder::default();
        let queries = Linear::new(&mut layout, "queries", 3, 4);
        let groups: &'static [Group] =
            vec![Group { queries: 0..2, keys: 0..3 }, Group { queries: 2..3, keys: 3..5 }].leak();
        let rows: &'static [usize] = vec![1, 0, 1, 1, 2].leak();
        let fixed: &'static [f32] = noise(7, 5 * 8).leak();
        let both = View::dense(fixed, 8);
        let attend = |tape: &mut Tape<'static>, x: Var, keys: Var, values: Var, rows| {
            let over = Over { queries: tape.linear(&queries, x), keys, values, rows, heads: 2, head_dim: 2 };
            let out = tape.reserve(3, 4);
            tape.attend_over(over, groups, &[Visible::All], out);
            out
        };
        for rows in [None, Some(rows)] {
            check_operation(layout.len(), &[(3, 3)], |tape, x| {
                let both = tape.constant(both);
                attend(tape, x[0], both.columns(0..4), both.columns(4..8), rows)
            });
            check_operation(layout.len(), &[(3, 3), (5, 4)], |tape, x| {
                let keys = tape.constant(both.columns(0..4));
                attend(tape, x[0], keys, x[1], rows)
            });
            check_operation(layout.len(), &[(3, 3), (5, 4)], |tape, x| {
                let values = tape.constant(both.columns(4..8));
                attend(tape, x[0], x[1], values, rows)
            });
        }
    }

    /// Keys that all heads share, and rows that several keys stand for: two groups' keys 0, 2 and 3 are one entity.
    #[test]
    fn shared_keys_and_shared_rows() {
        let mut layout = LayoutBuilder::default();
        let (queries, values) =
            (Linear::new(&mut layout, "queries", 3, 6), Linear::new(&mut layout, "values", 3, 4));
        let groups = [Group { queries: 0..2, keys: 0..3 }, Group { queries: 2..3, keys: 3..5 }];
        let rows = [1, 0, 1, 1, 2];
        let mask = [1, 0, 1, 1, 1, 1, 1, 1];
        let attend = |tape: &mut Tape<'_>, x: &[Var], rows: Option<&'static [usize]>| {
            let queries = tape.linear(&queries, x[0]);
            let values = tape.linear_relu(&values, x[1]);
            let over = Over { queries, keys: x[1], values, rows, heads: 2, head_dim: 2 };
            let out = tape.reserve(3, 4);
            tape.attend_over(
                over,
                Box::leak(Box::new(groups.clone())),
                &[Visible::Where(&*Box::leak(Box::new(mask)))],
                out,
            );
            out
        };
        let shared: &'static [usize] = Box::leak(Box::new(rows));
        check_operation(layout.len(), &[(3, 3), (3, 3)], |tape, x| attend(tape, x, Some(shared)));
        check_operation(layout.len(), &[(3, 3), (5, 3)], |tape, x| attend(tape, x, None));
        // The same as rows that are written out.
        let (params, of_queries, of_keys) = (noise(1, layout.len()), noise(2, 9), noise(3, 9));
        let written: Vec<f32> = rows.iter().flat_map(|&row| of_keys[row * 3..][..3].to_vec()).collect();
        let one = run_operation(&params, &[(&of_queries, 3), (&of_keys, 3)], |tape, x| {
            attend(tape, x, Some(shared))
        });
        let other =
            run_operation(&params, &[(&of_queries, 3), (&written, 3)], |tape, x| attend(tape, x, None));
        assert_eq!(one, other);
    }
}
