//! Layers that are made of other layers: where two linear maps follow each other, their product is made once for one set
//! of weights instead of both being applied to every row.
//!
//! Derived weights lie after the parameters in one *extended* buffer, and their gradients after the parameters'
//! gradients, so that networks use a derived layer like any other. [`Derived::extend`] makes them; [`Derived::backward`]
//! turns their gradients into gradients by the parameters they are made of.

use crate::{Accum, Attention, Linear, View, linear, math, matmul, vectorized};

/// Which layers are derived, and from what.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Derived {
    /// Parameters.
    parameters: usize,
    /// Parameters and derived weights.
    len: usize,
    made: Vec<Made>,
}

/// A derived layer.
#[derive(Clone, Debug, PartialEq)]
enum Made {
    /// `of` = `second` ∘ `first`, beside the rest of `second`'s inputs.
    Chain { first: Linear, second: Linear, of: Linear },
    /// `of` = keyᵀ query, head by head.
    Scores { query: Linear, key: Linear, heads: usize, of: Linear },
}

impl Derived {
    /// None yet, after this many parameters.
    pub fn new(parameters: usize) -> Self {
        Self { parameters, len: parameters, made: Vec::new() }
    }

    /// Numbers in an extended buffer.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is nothing, not even a parameter.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// [x ‖ rest] ↦ `second`([`first`(x) ‖ rest]): inputs of `first`, then those of `second` that `first` does not make.
    pub fn chain(&mut self, first: &Linear, second: &Linear) -> Linear {
        let of = self.layer(first.inputs + second.inputs - first.outputs, second.outputs);
        self.made.push(Made::Chain { first: first.clone(), second: second.clone(), of: of.clone() });
        of
    }

    /// x ↦ W_kᵀ (W_q x + b_q), head by head, (inputs) → (heads · inputs). A head's score of an entity x' is the dot product
    /// of this with x', because q · (W_k x') = (W_kᵀ q) · x': no keys have to be computed for entities.
    pub fn scores(&mut self, attention: &Attention) -> Linear {
        let (query, key, heads) = (attention.query.clone(), attention.key(), attention.heads);
        let of = self.layer(query.inputs, heads * key.inputs);
        self.made.push(Made::Scores { query, key, heads, of: of.clone() });
        of
    }

    fn layer(&mut self, inputs: usize, outputs: usize) -> Linear {
        let weight = self.len..self.len + inputs * outputs;
        let bias = weight.end..weight.end + outputs;
        self.len = bias.end;
        Linear::at(weight, bias, inputs)
    }

    /// Writes `params`, zeros for what they lack of all parameters, and the derived weights.
    pub fn extend(&self, params: &[f32], extended: &mut Vec<f32>) {
        extended.clear();
        extended.extend_from_slice(params);
        extended.resize(self.len, 0.0);
        let (params, derived) = extended.split_at_mut(self.parameters);
        for made in &self.made {
            made.forward(params, derived, self.parameters);
        }
    }

    /// Adds to the parameters' gradients what the derived weights' gradients say. Both lie in `grads`, extended like
    /// `params`.
    pub fn backward(&self, params: &[f32], grads: &mut [f32]) {
        let (grads, derived) = grads.split_at_mut(self.parameters);
        for made in &self.made {
            made.backward(&params[..self.parameters], derived, self.parameters, grads);
        }
    }
}

impl Made {
    /// Writes the derived layer; `derived` begins at `offset`.
    fn forward(&self, params: &[f32], derived: &mut [f32], offset: usize) {
        match self {
            Self::Chain { first, second, of } => {
                let of = of.moved_back(offset);
                let (made, rest) = (0..first.outputs, first.outputs..second.inputs);
                let weight = second.weight(params);
                let to = of.weight_mut(derived).columns(0..first.inputs);
                matmul::dy_w(weight.columns(made.clone()), first.weight(params), to, Accum::Replace);
                linear::copy(of.weight_mut(derived).columns(first.inputs..of.inputs), weight.columns(rest));
                let bias = of.bias_mut(derived);
                bias.copy_from_slice(second.bias(params));
                multiply(weight.columns(made), first.bias(params), bias);
            }
            Self::Scores { query, key, heads, of } => {
                let of = of.moved_back(offset);
                for head in 0..*heads {
                    let (rows, outputs) = head_rows(query, key, *heads, head);
                    let (query, key) = (query.output_rows(rows.clone()), key.output_rows(rows));
                    let of = of.output_rows(outputs);
                    let to = of.weight_mut(derived);
                    matmul::dyt_x(key.weight(params), query.weight(params), to, Accum::Replace);
                    let bias = of.bias_mut(derived);
                    bias.fill(0.0);
                    linear::add_weighted_rows(bias, query.bias(params), key.weight(params));
                }
            }
        }
    }

    /// Adds to the gradients of the layers it is made of.
    fn backward(&self, params: &[f32], derived: &[f32], offset: usize, grads: &mut [f32]) {
        match self {
            Self::Chain { first, second, of } => {
                let of = of.moved_back(offset);
                let (made, rest) = (0..first.outputs, first.outputs..second.inputs);
                let d = of.weight(derived);
                let (d_made, d_rest) = (d.columns(0..first.inputs), d.columns(first.inputs..of.inputs));
                let to = second.weight_mut(grads).columns(made.clone());
                matmul::x_wt(d_made, first.weight(params), to, Accum::Add);
                linear::add(second.weight_mut(grads).columns(rest), d_rest);
                let weight = second.weight(params).columns(made.clone());
                matmul::dyt_x(weight, d_made, first.weight_mut(grads), Accum::Add);
                let d_bias = of.bias(derived);
                linear::add_outer_product(second.weight_mut(grads).columns(made), d_bias, first.bias(params));
                linear::add_weighted_rows(first.bias_mut(grads), d_bias, weight);
                math::add_scaled(second.bias_mut(grads), 1.0, d_bias);
            }
            Self::Scores { query, key, heads, of } => {
                let of = of.moved_back(offset);
                for head in 0..*heads {
                    let (rows, outputs) = head_rows(query, key, *heads, head);
                    let (query, key) = (query.output_rows(rows.clone()), key.output_rows(rows));
                    let of = of.output_rows(outputs);
                    let (d, d_bias) = (of.weight(derived), of.bias(derived));
                    matmul::dy_w(key.weight(params), d, query.weight_mut(grads), Accum::Add);
                    matmul::x_wt(query.weight(params), d, key.weight_mut(grads), Accum::Add);
                    multiply(key.weight(params), d_bias, query.bias_mut(grads));
                    linear::add_outer_product(key.weight_mut(grads), query.bias(params), d_bias);
                }
            }
        }
    }
}

/// One head's rows of query and key, and its outputs.
fn head_rows(
    query: &Linear,
    key: &Linear,
    heads: usize,
    head: usize,
) -> (std::ops::Range<usize>, std::ops::Range<usize>) {
    let dim = query.outputs / heads;
    (head * dim..(head + 1) * dim, head * key.inputs..(head + 1) * key.inputs)
}

vectorized! {
    /// sums += w v: each row's product with a vector.
    fn multiply<'a>(w: View<'a>, v: &'a [f32], sums: &'a mut [f32]) {
        for (row, sum) in sums.iter_mut().enumerate() {
            *sum += math::dot(w.row(row), v);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        LayoutBuilder, ViewMut,
        gradcheck::{check, noise},
    };

    fn apply(layer: &Linear, params: &[f32], x: &[f32]) -> Vec<f32> {
        let mut y = vec![0.0; x.len() / layer.inputs * layer.outputs];
        layer.forward(params, View::dense(x, layer.inputs), ViewMut::dense(&mut y, layer.outputs));
        y
    }

    fn extended(derived: &Derived, params: &[f32]) -> Vec<f32> {
        let mut extended = vec![9.0; 3];
        derived.extend(params, &mut extended);
        extended
    }

    #[test]
    fn a_chain_is_one_layer_after_the_other() {
        let mut layout = LayoutBuilder::default();
        let first = Linear::new(&mut layout, "first", 3, 4);
        let second = Linear::new(&mut layout, "second", 4 + 2, 5);
        let mut derived = Derived::new(layout.len());
        let of = derived.chain(&first, &second);
        let params = extended(&derived, &noise(1, layout.len()));
        let x = noise(2, 3 + 2);
        let hidden = [&apply(&first, &params, &x[..3]), &x[3..]].concat();
        for (a, b) in apply(&of, &params, &x).iter().zip(apply(&second, &params, &hidden)) {
            assert!((a - b).abs() < 1e-5, "{a} {b}");
        }
    }

    #[test]
    fn scores_are_products_of_queries_and_keys() {
        for heads in [1, 2] {
            let mut layout = LayoutBuilder::default();
            let attention = Attention::new(&mut layout, "attention", 3, 4, heads);
            let mut derived = Derived::new(layout.len());
            let of = derived.scores(&attention);
            let params = extended(&derived, &noise(1, layout.len()));
            let (x, other) = (noise(2, 3), noise(3, 3));
            let (query, scores) = (apply(&attention.query, &params, &x), apply(&of, &params, &x));
            let keys = attention.key().weight(&params);
            for head in 0..heads {
                let dim = 4 / heads;
                let rows = head * dim..(head + 1) * dim;
                let expected: f32 = rows.map(|row| query[row] * math::dot(keys.row(row), &other)).sum();
                let found = math::dot(&scores[head * 3..][..3], &other);
                assert!((found - expected).abs() < 1e-5, "{found} {expected}");
            }
        }
    }

    #[test]
    fn gradients_are_the_numeric_ones() {
        let mut layout = LayoutBuilder::default();
        let attention = Attention::new(&mut layout, "attention", 3, 4, 2);
        let first = Linear::new(&mut layout, "first", 3, 4);
        let second = Linear::new(&mut layout, "second", 4 + 2, 5);
        let mut derived = Derived::new(layout.len());
        derived.scores(&attention);
        derived.chain(&first, &second);
        // The loss weighs every derived number, and every parameter a little by itself.
        let (params, to) = (noise(1, layout.len()), noise(2, derived.len()));
        let loss = |params: &[f32]| {
            extended(&derived, params).iter().zip(&to).map(|(x, to)| f64::from(x * to)).sum::<f64>()
        };
        let mut grads = to.clone();
        derived.backward(&extended(&derived, &params), &mut grads);
        check("params", &params, &grads[..layout.len()], loss);
    }
}
