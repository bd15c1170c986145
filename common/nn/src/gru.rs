//! A gated recurrent unit as PyTorch's `GRUCell` defines it, over rows that lie in time order.
//!
//! Rows are time-major. A row's predecessor is the row of the same place at the time before, so the rows of a
//! time are a prefix of those before: sequences are ordered longest first.

use crate::{
    Accum, Buffer, LayoutBuilder, Linear, Scratch, View, ViewMut, for_lanes, linear,
    math::{LANES, Lanes, each, load, sigmoid, store, tanh},
    matmul, vectorized,
};

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
    /// In: the input's share of the gates, Wᵢ x without its bias. Out: r, u, n. `[R, 3h]`.
    pub gates: Buffer,
    /// Wₕₙ h + bₕₙ, `[R, h]`.
    pub new_from_hidden: Buffer,
    /// The hidden state after each row, `[R, h]`.
    pub history: Buffer,
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

    /// Runs over all times. `state.gates` holds the input's share already: [`Gru::input`]'s weight, without its
    /// bias. `times[t]` is the first row of time t, its last element R. The state before the first time is
    /// `before` (rows of time 0, h), or zeros.
    pub fn forward(
        &self,
        params: &[f32],
        times: &[usize],
        before: Option<View<'_>>,
        state: &mut GruState,
        scratch: &mut Scratch,
    ) {
        let h = self.hidden_dim;
        let rows = times.last().copied().unwrap_or(0);
        debug_assert_eq!(state.gates.len(), rows * 3 * h);
        state.new_from_hidden.fit(rows * h);
        state.history.fit(rows * h);
        let mut from_hidden = scratch.take(times.get(1).map_or(0, |&rows| rows * 3 * h));
        for (time, range) in times.windows(2).map(|pair| pair[0]..pair[1]).enumerate() {
            let (done, ahead) = state.history.split_at_mut(range.start * h);
            let previous = match before {
                Some(before) if time == 0 => before,
                None if time == 0 => View::dense(&[], h),
                _ => View::dense(&done[times[time - 1] * h..], h).rows(0..range.len()),
            };
            let from_hidden = &mut from_hidden[..range.len() * 3 * h];
            if previous.rows > 0 {
                let to = ViewMut::dense(from_hidden, 3 * h);
                matmul::x_wt(previous, self.hidden.weight(params), to, Accum::Replace);
            } else {
                from_hidden.fill(0.0);
            }
            step(
                &mut state.gates[range.start * 3 * h..range.end * 3 * h],
                from_hidden,
                [self.input.bias(params), self.hidden.bias(params)],
                previous,
                &mut state.new_from_hidden[range.start * h..range.end * h],
                &mut ahead[..range.len() * h],
                h,
            );
        }
        scratch.give(from_hidden);
    }

    /// Takes `d_history` (R, h), the loss's gradient by each row's hidden state where it is used outside the
    /// recurrence; overwrites it with the whole gradient, `gates` with the gradient by the input's share
    /// of the gates, and adds to the gradients of the hidden weights and both biases. The weights of
    /// [`Gru::input`] are the caller's. `history` (R, h) is what forward left.
    ///
    /// The state before the first time is taken as zeros.
    #[allow(clippy::too_many_arguments, reason = "a matrix and its companions, each named")]
    pub fn backward(
        &self,
        params: &[f32],
        times: &[usize],
        (gates, new_from_hidden): (&mut [f32], &[f32]),
        history: &[f32],
        d_history: &mut [f32],
        grads: &mut [f32],
        scratch: &mut Scratch,
    ) {
        let h = self.hidden_dim;
        let mut d_from_hidden = scratch.take(times.get(1).map_or(0, |&rows| rows * 3 * h));
        for time in (0..times.len() - 1).rev() {
            let range = times[time]..times[time + 1];
            let before = if time == 0 { range.start } else { times[time - 1] };
            let (d_done, d_ahead) = d_history.split_at_mut(range.start * h);
            let d_previous = &mut d_done[before * h..];
            let previous = if time == 0 { &[] } else { &history[before * h..][..range.len() * h] };
            let d_from_hidden = &mut d_from_hidden[..range.len() * 3 * h];
            step_backward(
                &mut gates[range.start * 3 * h..range.end * 3 * h],
                &new_from_hidden[range.start * h..range.end * h],
                previous,
                &d_ahead[..range.len() * h],
                d_from_hidden,
                d_previous,
                h,
            );
            let d_from_hidden = View::dense(d_from_hidden, 3 * h);
            linear::add_column_sums(d_from_hidden, self.hidden.bias_mut(grads));
            if time > 0 {
                let d_previous = ViewMut::dense(d_previous, h).rows(0..range.len());
                matmul::dy_w(d_from_hidden, self.hidden.weight(params), d_previous, Accum::Add);
                matmul::dyt_x(
                    d_from_hidden,
                    View::dense(previous, h),
                    self.hidden.weight_mut(grads),
                    Accum::Add,
                );
            }
        }
        scratch.give(d_from_hidden);
        linear::add_column_sums(View::dense(gates, 3 * h), self.input.bias_mut(grads));
    }
}

vectorized! {
    /// The rows of one time. `gates` [rows, 3h] holds the input's share and is left with r, u, n; `biases` are
    /// the input's and the hidden state's; `previous` has no rows where it is zeros.
    fn step<'a>(
        gates: &'a mut [f32],
        from_hidden: &'a [f32],
        biases: [&'a [f32]; 2],
        previous: View<'a>,
        new_from_hidden: &'a mut [f32],
        next: &'a mut [f32],
        h: usize,
    ) {
        let [input, hidden] = biases;
        for row in 0..next.len() / h {
            let gates = &mut gates[row * 3 * h..][..3 * h];
            let from_hidden = &from_hidden[row * 3 * h..][..3 * h];
            for_lanes!(0..h, |at, len| {
                let r = gate_sum(gates, from_hidden, input, hidden, at, len);
                let u = gate_sum(gates, from_hidden, input, hidden, h + at, len);
                let (r, u) = (each(|lane| sigmoid(r[lane])), each(|lane| sigmoid(u[lane])));
                let (x, f) = (load(gates, 2 * h + at, len), load(from_hidden, 2 * h + at, len));
                let (i, b) = (load(input, 2 * h + at, len), load(hidden, 2 * h + at, len));
                let hn = each(|lane| f[lane] + b[lane]);
                let n = each(|lane| tanh(r[lane].mul_add(hn[lane], x[lane] + i[lane])));
                let previous = if previous.rows == 0 { [0.0; LANES] } else { load(previous.row(row), at, len) };
                let new = each(|lane| u[lane].mul_add(previous[lane] - n[lane], n[lane]));
                store(r, gates, at, len);
                store(u, gates, h + at, len);
                store(n, gates, 2 * h + at, len);
                store(hn, new_from_hidden, row * h + at, len);
                store(new, next, row * h + at, len);
            });
        }
    }
}

vectorized! {
    /// The rows of one time backward. `gates` holds r, u, n and is left with the gradient by the input's share;
    /// `d_from_hidden` gets that by the hidden state's; u ⊙ d_next is added to `d_previous`. `previous` is
    /// empty where it is zeros.
    fn step_backward<'a>(
        gates: &'a mut [f32],
        new_from_hidden: &'a [f32],
        previous: &'a [f32],
        d_next: &'a [f32],
        d_from_hidden: &'a mut [f32],
        d_previous: &'a mut [f32],
        h: usize,
    ) {
        for row in 0..d_next.len() / h {
            let gates = &mut gates[row * 3 * h..][..3 * h];
            let d_from_hidden = &mut d_from_hidden[row * 3 * h..][..3 * h];
            for_lanes!(0..h, |at, len| {
                let (r, u) = (load(gates, at, len), load(gates, h + at, len));
                let n = load(gates, 2 * h + at, len);
                let hn = load(new_from_hidden, row * h + at, len);
                let d = load(d_next, row * h + at, len);
                let mut before = [0.0; LANES];
                if !previous.is_empty() {
                    before = load(previous, row * h + at, len);
                    let d_before = load(d_previous, row * h + at, len);
                    let d_before = each(|lane| d[lane].mul_add(u[lane], d_before[lane]));
                    store(d_before, d_previous, row * h + at, len);
                }
                let du = each(|lane| (before[lane] - n[lane]) * d[lane] * u[lane] * (1.0 - u[lane]));
                let dn = each(|lane| d[lane] * (1.0 - u[lane]) * (1.0 - n[lane] * n[lane]));
                let dr = each(|lane| dn[lane] * hn[lane] * r[lane] * (1.0 - r[lane]));
                let d_hn = each(|lane| dn[lane] * r[lane]);
                store(dr, gates, at, len);
                store(du, gates, h + at, len);
                store(dn, gates, 2 * h + at, len);
                store(dr, d_from_hidden, at, len);
                store(du, d_from_hidden, h + at, len);
                store(d_hn, d_from_hidden, 2 * h + at, len);
            });
        }
    }
}

/// A gate before its activation: both shares and both biases.
#[inline(always)]
fn gate_sum(x: &[f32], from_hidden: &[f32], input: &[f32], hidden: &[f32], at: usize, len: usize) -> Lanes {
    let (x, f) = (load(x, at, len), load(from_hidden, at, len));
    let (i, b) = (load(input, at, len), load(hidden, at, len));
    each(|lane| x[lane] + f[lane] + (i[lane] + b[lane]))
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
        let gates = state.gates.fit(x.len() / INPUTS * 3 * H);
        let to = ViewMut::dense(gates, 3 * H);
        matmul::x_wt(View::dense(x, INPUTS), gru.input.weight(params), to, Accum::Replace);
        gru.forward(params, times, before, &mut state, &mut Scratch::default());
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
        let mut before: Option<Buffer> = None;
        for time in TIMES.windows(2) {
            let rows = time[1] - time[0];
            let x = &x[time[0] * INPUTS..time[1] * INPUTS];
            let previous = before.as_ref().map(|h| View::dense(h, H).rows(0..rows));
            let state = run(&gru, &params, x, &[0, rows], previous);
            assert_eq!(state.history[..], all.history[time[0] * H..time[1] * H]);
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
        let GruState { gates, new_from_hidden, history } = &mut state;
        let (left, scratch) = ((&mut gates[..], &new_from_hidden[..]), &mut Scratch::default());
        gru.backward(&params, &TIMES, left, history, &mut d_history, &mut grads, scratch);
        let d_gates = View::dense(&state.gates, 3 * H);
        matmul::dyt_x(d_gates, View::dense(&x, INPUTS), gru.input.weight_mut(&mut grads), Accum::Add);
        matmul::dy_w(d_gates, gru.input.weight(&params), ViewMut::dense(&mut dx, INPUTS), Accum::Replace);
        check("params", &params, &grads, |params| loss(params, &x));
        check("x", &x, &dx, |x| loss(&params, x));
    }
}
