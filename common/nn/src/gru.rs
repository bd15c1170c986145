//! A gated recurrent unit as PyTorch's `GRUCell` defines it, over rows that lie in time order.
//!
//! Rows are time-major. A row's predecessor is the row of the same place at the time before, so the rows of a
//! time are a prefix of those before: sequences are ordered longest first.

use crate::{LayoutBuilder, Linear, View, ViewMut, linear, math, matmul};
use faer::Accum;

/// The unit: gates in the order reset r, update u, new n;
/// n = tanh(Wᵢₙ x + bᵢₙ + r ⊙ (Wₕₙ h + bₕₙ)), h' = (1 − u) ⊙ n + u ⊙ h.
#[derive(Clone, Debug)]
pub struct Gru {
    /// Input to gates, (3h, in) and (3h).
    pub input: Linear,
    /// Hidden state to gates, (3h, h) and (3h).
    hidden: Linear,
    /// h: size of the hidden state.
    pub hidden_dim: usize,
}

/// What forward leaves for backward. With R rows over all times:
#[derive(Debug, Default)]
pub struct GruState {
    /// In: the input's share of the gates. Out: r, u, n. `[R, 3h]`.
    pub gates: Vec<f32>,
    /// The hidden state's share of the gates, `[R, 3h]`.
    from_hidden: Vec<f32>,
    /// The hidden state after each row, `[R, h]`.
    pub history: Vec<f32>,
}

impl Gru {
    /// Declares `{name}.weight_ih`, `.weight_hh`, `.bias_ih`, `.bias_hh`, all uniform in ± 1/√h.
    pub fn new(layout: &mut LayoutBuilder, name: &str, inputs: usize, hidden_dim: usize) -> Self {
        let bound = 1.0 / (hidden_dim as f32).sqrt();
        let mut declare = |weight, bias, inputs| {
            let weight = layout.add(format!("{name}.{weight}"), &[3 * hidden_dim, inputs], bound);
            let bias = layout.add(format!("{name}.{bias}"), &[3 * hidden_dim], bound);
            Linear::at(weight, bias, inputs)
        };
        let input = declare("weight_ih", "bias_ih", inputs);
        let hidden = declare("weight_hh", "bias_hh", hidden_dim);
        Self { input, hidden, hidden_dim }
    }

    /// Runs over all times. `state.gates` holds the input's share already (see [`Gru::input`]); `times[t]` is
    /// the first row of time t, its last element R. The state before the first time is `before`
    /// (rows of time 0, h), or zeros.
    pub fn forward(&self, params: &[f32], times: &[usize], before: Option<View<'_>>, state: &mut GruState) {
        let h = self.hidden_dim;
        let rows = times.last().copied().unwrap_or(0);
        debug_assert_eq!(state.gates.len(), rows * 3 * h);
        crate::fit(&mut state.from_hidden, rows * 3 * h);
        crate::fit(&mut state.history, rows * h);
        linear::fill_rows(ViewMut::dense(&mut state.from_hidden, 3 * h), self.hidden.bias(params));
        for (time, range) in times.windows(2).map(|pair| pair[0]..pair[1]).enumerate() {
            let (done, ahead) = state.history.split_at_mut(range.start * h);
            let previous = if time == 0 {
                before
            } else {
                Some(View::dense(&done[times[time - 1] * h..], h).rows(0..range.len()))
            };
            let from_hidden = &mut state.from_hidden[range.start * 3 * h..range.end * 3 * h];
            if let Some(previous) = previous {
                let to = ViewMut::dense(from_hidden, 3 * h);
                matmul::x_wt(previous, self.hidden.weight(params), to, Accum::Add);
            }
            let gates = &mut state.gates[range.start * 3 * h..range.end * 3 * h];
            math::vectorized(|| {
                for row in 0..range.len() {
                    let previous = previous.map_or(&[][..], |previous| previous.row(row));
                    let at = row * 3 * h..(row + 1) * 3 * h;
                    step(&mut gates[at.clone()], &from_hidden[at], previous, &mut ahead[row * h..][..h]);
                }
            });
        }
    }

    /// Takes `d_history` (R, h), the loss's gradient by each row's hidden state where it is used outside the
    /// recurrence; overwrites it with the whole gradient, `state.gates` with the gradient by the input's share
    /// of the gates, and adds to the gradients of the hidden weights and both biases. The weights of
    /// [`Gru::input`] are the caller's.
    ///
    /// The state before the first time is taken as zeros.
    pub fn backward(
        &self,
        params: &[f32],
        times: &[usize],
        state: &mut GruState,
        d_history: &mut [f32],
        grads: &mut [f32],
    ) {
        let h = self.hidden_dim;
        let history = &state.history;
        for time in (0..times.len() - 1).rev() {
            let range = times[time]..times[time + 1];
            let before = if time == 0 { range.start } else { times[time - 1] };
            let (d_done, d_ahead) = d_history.split_at_mut(range.start * h);
            let d_previous = &mut d_done[before * h..];
            let previous = &history[before * h..];
            let gates = &mut state.gates[range.start * 3 * h..range.end * 3 * h];
            let from_hidden = &mut state.from_hidden[range.start * 3 * h..range.end * 3 * h];
            math::vectorized(|| {
                for row in 0..range.len() {
                    let at = row * 3 * h..(row + 1) * 3 * h;
                    let (previous, d_previous) = if time == 0 {
                        (&[][..], &mut [][..])
                    } else {
                        (&previous[row * h..][..h], &mut d_previous[row * h..][..h])
                    };
                    let d_next = &d_ahead[row * h..][..h];
                    let (gates, from_hidden) = (&mut gates[at.clone()], &mut from_hidden[at]);
                    step_backward(gates, from_hidden, previous, d_next, d_previous);
                }
            });
            if time > 0 {
                let d_from_hidden = View::dense(from_hidden, 3 * h);
                let d_previous = ViewMut::dense(d_previous, h).rows(0..range.len());
                matmul::dy_w(d_from_hidden, self.hidden.weight(params), d_previous, Accum::Add);
                let previous = View::dense(&previous[..range.len() * h], h);
                matmul::dyt_x(d_from_hidden, previous, self.hidden.weight_mut(grads));
            }
        }
        let rows = |gates| View::dense(gates, 3 * h);
        linear::add_column_sums(rows(&state.from_hidden), self.hidden.bias_mut(grads));
        linear::add_column_sums(rows(&state.gates), self.input.bias_mut(grads));
    }
}

/// One row forward. `gates` holds the input's share and is left with r, u, n; `previous` is empty for zeros.
#[inline(always)]
fn step(gates: &mut [f32], from_hidden: &[f32], previous: &[f32], next: &mut [f32]) {
    let h = next.len();
    let (r, rest) = gates.split_at_mut(h);
    let (u, n) = rest.split_at_mut(h);
    let (hr, rest) = from_hidden.split_at(h);
    let (hu, hn) = rest.split_at(h);
    for i in 0..h {
        r[i] = math::sigmoid(r[i] + hr[i]);
        u[i] = math::sigmoid(u[i] + hu[i]);
        n[i] = math::tanh(n[i] + r[i] * hn[i]);
        next[i] = n[i] - u[i] * n[i];
    }
    for (next, (u, previous)) in next.iter_mut().zip(u.iter().zip(previous)) {
        *next += u * previous;
    }
}

/// One row backward. `gates` holds r, u, n and is left with the gradient by the input's share; `from_hidden`
/// likewise by the hidden state's share; u ⊙ d_next is added to `d_previous`.
#[inline(always)]
fn step_backward(
    gates: &mut [f32],
    from_hidden: &mut [f32],
    previous: &[f32],
    d_next: &[f32],
    d_previous: &mut [f32],
) {
    let h = d_next.len();
    let (r, rest) = gates.split_at_mut(h);
    let (u, n) = rest.split_at_mut(h);
    let (hr, rest) = from_hidden.split_at_mut(h);
    let (hu, hn) = rest.split_at_mut(h);
    for (d_previous, (d_next, u)) in d_previous.iter_mut().zip(d_next.iter().zip(u.iter())) {
        *d_previous += d_next * u;
    }
    // du first needs h − n; without a previous state h is 0.
    for i in 0..h {
        hu[i] = -n[i];
    }
    for (hu, previous) in hu.iter_mut().zip(previous) {
        *hu += previous;
    }
    for i in 0..h {
        let du = d_next[i] * hu[i] * u[i] * (1.0 - u[i]);
        let dn = d_next[i] * (1.0 - u[i]) * (1.0 - n[i] * n[i]);
        let dr = dn * hn[i] * r[i] * (1.0 - r[i]);
        (hr[i], hu[i], hn[i]) = (dr, du, dn * r[i]);
        (r[i], u[i], n[i]) = (dr, du, dn);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gradcheck::{check, noise};

    /// Three sequences of lengths 3, 2 and 1.
    const TIMES: [usize; 4] = [0, 3, 5, 6];
    const INPUTS: usize = 4;
    const H: usize = 5;

    fn unit() -> (Gru, usize) {
        let mut layout = LayoutBuilder::default();
        let gru = Gru::new(&mut layout, "gru", INPUTS, H);
        (gru, layout.len())
    }

    fn run(gru: &Gru, params: &[f32], x: &[f32], times: &[usize], before: Option<View<'_>>) -> GruState {
        let mut state = GruState::default();
        let gates = crate::fit(&mut state.gates, x.len() / INPUTS * 3 * H);
        gru.input.forward(params, View::dense(x, INPUTS), ViewMut::dense(gates, 3 * H));
        gru.forward(params, times, before, &mut state);
        state
    }

    /// The equations as PyTorch's documentation states them, one number at a time.
    fn reference(params: &[f32], x: &[f32], h: &[f32]) -> Vec<f32> {
        let (w_ih, rest) = params.split_at(3 * H * INPUTS);
        let (b_ih, rest) = rest.split_at(3 * H);
        let (w_hh, b_hh) = rest.split_at(3 * H * H);
        let sum = |w: &[f32], v: &[f32], row: usize| -> f32 {
            v.iter().zip(&w[row * v.len()..]).map(|(v, w)| v * w).sum()
        };
        let sigmoid = |x: f32| 1.0 / (1.0 + (-x).exp());
        (0..H)
            .map(|i| {
                let r = sigmoid(sum(w_ih, x, i) + b_ih[i] + sum(w_hh, h, i) + b_hh[i]);
                let u = sigmoid(sum(w_ih, x, H + i) + b_ih[H + i] + sum(w_hh, h, H + i) + b_hh[H + i]);
                let hn = sum(w_hh, h, 2 * H + i) + b_hh[2 * H + i];
                let n = (sum(w_ih, x, 2 * H + i) + b_ih[2 * H + i] + r * hn).tanh();
                (1.0 - u) * n + u * h[i]
            })
            .collect()
    }

    #[test]
    fn follows_the_equations_row_by_row() {
        let (gru, len) = unit();
        let (params, x) = (noise(1, len), noise(2, 6 * INPUTS));
        let state = run(&gru, &params, &x, &TIMES, None);
        // Row 0's sequence is rows 0, 3, 5; row 1's is 1, 4; row 2 stands alone.
        for sequence in [&[0, 3, 5][..], &[1, 4], &[2]] {
            let mut h = vec![0.0; H];
            for &row in sequence {
                h = reference(&params, &x[row * INPUTS..][..INPUTS], &h);
                for (a, b) in state.history[row * H..][..H].iter().zip(&h) {
                    assert!((a - b).abs() < 1e-6, "row {row}: {a} {b}");
                }
            }
        }
    }

    #[test]
    fn one_time_at_a_time_is_the_same_to_the_bit() {
        let (gru, len) = unit();
        let (params, x) = (noise(1, len), noise(2, 6 * INPUTS));
        let all = run(&gru, &params, &x, &TIMES, None);
        let mut before: Option<Vec<f32>> = None;
        for time in TIMES.windows(2) {
            let rows = time[1] - time[0];
            let x = &x[time[0] * INPUTS..time[1] * INPUTS];
            let previous = before.as_ref().map(|h| View::dense(h, H).rows(0..rows));
            let state = run(&gru, &params, x, &[0, rows], previous);
            assert_eq!(state.history, all.history[time[0] * H..time[1] * H]);
            before = Some(state.history);
        }
    }

    #[test]
    fn gradients_are_the_numeric_ones() {
        let (gru, len) = unit();
        let (params, x, to) = (noise(1, len), noise(2, 6 * INPUTS), noise(3, 6 * H));
        let loss = |params: &[f32], x: &[f32]| {
            let state = run(&gru, params, x, &TIMES, None);
            state.history.iter().zip(&to).map(|(h, to)| f64::from(h * to)).sum()
        };
        let mut state = run(&gru, &params, &x, &TIMES, None);
        let (mut grads, mut dx, mut d_history) = (vec![0.0; len], vec![0.0; x.len()], to.clone());
        gru.backward(&params, &TIMES, &mut state, &mut d_history, &mut grads);
        let d_gates = View::dense(&state.gates, 3 * H);
        matmul::dyt_x(d_gates, View::dense(&x, INPUTS), gru.input.weight_mut(&mut grads));
        matmul::dy_w(d_gates, gru.input.weight(&params), ViewMut::dense(&mut dx, INPUTS), Accum::Replace);
        check("params", &params, &grads, |params| loss(params, &x));
        check("x", &x, &dx, |x| loss(&params, x));
    }
}
