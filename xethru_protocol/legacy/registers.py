"""Fields of the X4 chip's registers by name, as ``pymoduleconnector.extras.x4_regmap_autogen.X4``.

::

    regmap = X4(mc.get_xep())
    regmap.tx_power = 1
"""

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

from xethru_protocol.legacy.data import MISSING, not_implemented

# In each space a register's address and its fields as name:highest bit:lowest bit. A field with *
# can only be read; one with ! is an action, which any write starts. Source: the names and places of
# the chip's datasheet, as the vendor's register map has them.
_MAP: Final = """
[pif]
0 firmware_version:7:0
6 gpio_o:6:0
11 gpio_i*:6:0
13 gpio_output_enable:6:0
14 rx_mframes:7:0
15 hpf_disable_feedforward:2:2 powerdown_sampler:1:1 rx_downconversion_enable:0:0
16 rx_downconversion_coeff_i1:5:0
17 rx_downconversion_coeff_i2:5:0
20 rx_downconversion_coeff_q1:5:0
21 rx_downconversion_coeff_q2:5:0
22 rx_ram_write_offset_msb:7:0
23 rx_ram_line_first_msb:7:0
24 rx_ram_line_last_msb:7:0
25 rx_ram_write_offset_lsb:2:2 rx_ram_line_first_lsb:1:1 rx_ram_line_last_lsb:0:0
27 rx_counter_num_bytes:2:0
28 rx_counter_lsb:5:0
29 fetch_radar_data_spi!
30 fetch_radar_data_pif!
31 radar_data_pif*:7:0
33 pif_radar_data_pif_fifo_overflow*:7:7 pif_radar_data_pif_fifo_underflow*:6:6
    pif_radar_data_spi_fifo_overflow*:5:5 pif_radar_data_spi_fifo_underflow*:4:4
    radar_data_pif_fifo_empty*:0:0
34 pif_clear_radar_data_pif_fifo_overflow:7:7 pif_clear_radar_data_pif_fifo_underflow:6:6
    pif_clear_radar_data_spi_fifo_overflow:5:5 pif_clear_radar_data_spi_fifo_underflow:4:4
35 pif_radar_data0_fifo_overflow*:7:7 pif_radar_data0_fifo_underflow*:6:6
    pif_fifo_ram_word0_overflow*:5:5 pif_fifo_ram_word0_underflow*:4:4
    pif_fifo_sample0_overflow*:3:3 pif_fifo_sample0_underflow*:2:2
36 pif_clear_radar_data0_fifo_overflow:7:7 pif_clear_radar_data0_fifo_underflow:6:6
    pif_clear_fifo_ram_word0_overflow:5:5 pif_clear_fifo_ram_word0_underflow:4:4
    pif_clear_fifo_sample0_overflow:3:3 pif_clear_fifo_sample0_underflow:2:2
37 pif_radar_data1_fifo_overflow*:7:7 pif_radar_data1_fifo_underflow*:6:6
    pif_fifo_ram_word1_overflow*:5:5 pif_fifo_ram_word1_underflow*:4:4
    pif_fifo_sample1_overflow*:3:3 pif_fifo_sample1_underflow*:2:2
38 pif_clear_radar_data1_fifo_overflow:7:7 pif_clear_radar_data1_fifo_underflow:6:6
    pif_clear_fifo_ram_word1_overflow:5:5 pif_clear_fifo_ram_word1_underflow:4:4
    pif_clear_fifo_sample1_overflow:3:3 pif_clear_fifo_sample1_underflow:2:2
39 ram_select:0:0
42 radar_readout_idle*:0:0
43 rx_reset_counters!
44 trx_clocks_per_pulse:7:0
45 rx_mframes_coarse:7:0
46 trx_pulses_per_step_msb:7:0
47 trx_pulses_per_step_lsb:7:0
48 trx_dac_max_h:7:0
49 trx_dac_max_l:2:0
50 trx_dac_min_h:7:0
51 trx_dac_min_l:2:0
52 trx_auto_bidir_enable:5:5 trx_sweep_phase:4:4 trx_dac_settle_clog2:3:2 trx_dac_step_clog2:1:0
53 trx_iterations:7:0
54 trx_start!
55 trx_ctrl_done*:0:0
58 trx_backend_done*:0:0
59 tx_strobe_enable:7:7 rx_strobe_enable:6:6 trx_phase_override:5:5 trx_phase_override_val:4:4
    trx_send_every_pulse:3:3 trx_constant_clocks_per_pulse:2:2 trx_ctrl_slave_mode:1:1
    trx_start_sync_negedge:0:0
60 trx_lfsr_taps_0:7:0
61 trx_lfsr_taps_1:7:0
62 noiseless_ghost_order:6:4 trx_lfsr_taps_2:3:0
65 trx_lfsr_reset!
66 rx_wait:7:0
67 tx_wait:3:0
68 trx_dac_override_enable:7:7 trx_dac_override_val_h:2:0
69 trx_dac_override_val_l:7:0
70 trx_dac_override_load!
71 spi_master_clk_div:7:5 spi_master_clk_sel:4:4 cpuclk_div:3:1 cpuclk_sel:0:0
73 mclk_sel:7:6 trx_backend_clk_prescale:5:3 trx_backend_clk_div:2:0
74 auxclk_sel:6:6 sysclk_sel:5:5 xosc_bypass:4:4 xosc_dislvl:3:3 xosc_discap:2:2 xosc_en:1:1
    lpclk_disable:0:0
75 spiclk_ren:7:7 spio_ren:6:5 io_ren:4:0
76 lvds_rt_cal:7:6 lvds_rt_en:5:5 lvcmos_schmitt_en:4:4 io6_lvcmos_ie:3:3 io5_lvcmos_ie:2:2
    lvds_rx_en:1:1 sub_lvds_en:0:0
77 lvds_tx_en:7:7 io_gpio_sel:6:0
78 lvds_clkout_sel:7:7 io6_clkout_sel:6:6 io5_clkout_sel:5:5 extclk_sel:4:4 lvds_txdrv:3:2
    lvds_biastrim:1:0
79 lpclk_trim:7:3 io3_spi_sel:2:2 trx_sync_source_sel:1:1 io1_spi_sel:0:0
81 io2_test_sel:4:2 io6_clkout_oe:1:1 io5_clkout_oe:0:0
82 pif_to_cpu_fifo_overflow*:7:7 pif_to_cpu_fifo_underflow*:6:6 pif_from_cpu_fifo_overflow*:5:5
    pif_from_cpu_fifo_underflow*:4:4 from_cpu_fifo_empty*:2:2 to_cpu_data_valid*:1:1
    from_cpu_fifo_full*:0:0
83 to_cpu_read_data*:7:0
84 from_cpu_write_data:7:0
85 pif_clear_to_cpu_fifo_overflow:7:7 pif_clear_to_cpu_fifo_underflow:6:6
    pif_clear_from_cpu_fifo_overflow:5:5 pif_clear_from_cpu_fifo_underflow:4:4
86 pif_to_mem_fifo_overflow*:7:7 pif_to_mem_fifo_underflow*:6:6 pif_from_mem_fifo_overflow*:5:5
    pif_from_mem_fifo_underflow*:4:4
87 pif_clear_to_mem_fifo_overflow:7:7 pif_clear_to_mem_fifo_underflow:6:6
    pif_clear_from_mem_fifo_overflow:5:5 pif_clear_from_mem_fifo_underflow:4:4
88 spi_master_send:0:0
89 spi_master_radar_burst_kick!
90 spi_master_nss*:1:1 spi_master_idle*:0:0
91 spi_master_radar_burst_size_msb:7:3 spi_slave_sel:2:1 spi_master_mode:0:0
92 spi_master_radar_burst_size_lsb:7:0
93 otp_ctrl_load:0:0
94 boot_from_otp_pif:0:0
95 rx_pll_fbdiv:6:4 rx_pll_foutt_sel:3:0
97 rx_pll_postdiv:5:3 rx_pll_powerdown:2:2 rx_pll_powerdown_foutdiv:1:1 rx_pll_powerdown_foutt:0:0
98 rx_pll_skewfastcal:5:5 rx_pll_skewcalcnt:4:2 rx_pll_skewcalbyp:1:1 rx_pll_skewcalen:0:0
99 rx_pll_skewcalin:6:0
100 rx_pll_lock*:7:7 rx_pll_skewcalout*:6:0
101 tx_pll_fbdiv:6:4 tx_pll_foutt_sel:3:0
102 tx_pll_postdiv:5:3 tx_pll_powerdown:2:2 tx_pll_powerdown_foutdiv:1:1
    tx_pll_powerdown_foutt:0:0
103 tx_pll_skewfastcal:5:5 tx_pll_skewcalcnt:4:2 tx_pll_skewcalbyp:1:1 tx_pll_skewcalen:0:0
104 tx_pll_skewcalin:6:0
105 tx_pll_lock*:7:7 tx_pll_skewcalout*:6:0
106 common_pll_powerdown:7:7 common_pll_dsmpd:6:6 common_pll_dacpd:5:5
    common_pll_internal_bypass:4:4 common_pll_fbdiv_msb:3:0
107 common_pll_fbdiv_lsb:7:0
108 common_pll_foutpostdivpd:7:7 common_pll_foutvcopd:6:6 common_pll_refdiv:5:0
109 common_pll_fout4phasepd:7:7 common_pll_external_bypass:6:6 common_pll_postdiv1:5:3
    common_pll_postdiv2:2:0
110 common_pll_frac_2:7:0
111 common_pll_frac_1:7:0
113 common_pll_frac_0:7:0
114 common_pll_lock*:7:7 xosc_lock*:6:6
115 cmu_clkout_sel:7:6 pllauxclk_sel:5:4 trx_clkout_1_sel:3:2 trx_clkout_2_sel:1:0
116 apc_testmode:7:4 dvdd_testmode:3:0
117 tx_bandsel:7:7 tx_power:6:5 dvdd_trim:4:0
118 dvdd_rx_disable:6:6 dvdd_rx_disable_pulldown:5:5 dvdd_rx_trim:4:0
120 dvdd_tx_disable:6:6 dvdd_tx_disable_pulldown:5:5 dvdd_tx_trim:4:0
121 dvdd_rx_testmode:7:4 dvdd_tx_testmode:3:0
122 avdd_rx_disable:6:6 avdd_rx_disable_pulldown:5:5 avdd_rx_trim:4:0
123 avdd_tx_disable:6:6 avdd_tx_disable_pulldown:5:5 avdd_tx_trim:4:0
124 avdd_rx_testmode:7:4 avdd_tx_testmode:3:0
125 avdd_rx_anatestreq*:7:7 avdd_rx_digtestbus*:6:6 avdd_tx_anatestreq*:5:5
    avdd_tx_digtestbus*:4:4 dvdd_rx_anatestreq*:3:3 dvdd_rx_digtestbus*:2:2
    dvdd_tx_anatestreq*:1:1 dvdd_tx_digtestbus*:0:0
126 dvdd_anatestreq*:7:7 dvdd_digtestbus*:6:6 apc_anatestreq*:5:5 apc_digtestbus*:4:4
    dvdd_rx_power_good*:3:3 dvdd_tx_power_good*:2:2 avdd_rx_power_good*:1:1
    avdd_tx_power_good*:0:0
127 spi_mode_pif:0:0
[spi]
0 force_zero*:7:0
1 force_one*:7:0
2 chip_id_dig*:7:0
3 chip_id_sys*:7:0
4 debug:7:0
5 radar_data_spi*:7:0
6 spi_radar_data_spi_fifo_overflow*:7:7 spi_radar_data_spi_fifo_underflow*:6:6
    spi_radar_data_pif_fifo_overflow*:5:5 spi_radar_data_pif_fifo_underflow*:4:4
    radar_data_spi_fifo_empty*:0:0
7 spi_clear_radar_data_spi_fifo_overflow:7:7 spi_clear_radar_data_spi_fifo_underflow:6:6
    spi_clear_radar_data_pif_fifo_overflow:5:5 spi_clear_radar_data_pif_fifo_underflow:4:4
8 spi_radar_data0_fifo_overflow*:7:7 spi_radar_data0_fifo_underflow*:6:6
    spi_fifo_ram_word0_overflow*:5:5 spi_fifo_ram_word0_underflow*:4:4
    spi_fifo_sample0_overflow*:3:3 spi_fifo_sample0_underflow*:2:2
9 spi_clear_radar_data0_fifo_overflow:7:7 spi_clear_radar_data0_fifo_underflow:6:6
    spi_clear_fifo_ram_word0_overflow:5:5 spi_clear_fifo_ram_word0_underflow:4:4
    spi_clear_fifo_sample0_overflow:3:3 spi_clear_fifo_sample0_underflow:2:2
10 spi_radar_data1_fifo_overflow*:7:7 spi_radar_data1_fifo_underflow*:6:6
    spi_fifo_ram_word1_overflow*:5:5 spi_fifo_ram_word1_underflow*:4:4
    spi_fifo_sample1_overflow*:3:3 spi_fifo_sample1_underflow*:2:2
11 spi_clear_radar_data1_fifo_overflow:7:7 spi_clear_radar_data1_fifo_underflow:6:6
    spi_clear_fifo_ram_word1_overflow:5:5 spi_clear_fifo_ram_word1_underflow:4:4
    spi_clear_fifo_sample1_overflow:3:3 spi_clear_fifo_sample1_underflow:2:2
12 smpl_ram1_bist_en:1:1 smpl_ram0_bist_en:0:0
13 smpl_ram1_bist_pass*:3:3 smpl_ram1_bist_done*:2:2 smpl_ram0_bist_pass*:1:1
    smpl_ram0_bist_done*:0:0
14 firmware_version_spi*:7:0
15 to_cpu_write_data:7:0
16 spi_to_cpu_fifo_overflow*:7:7 spi_to_cpu_fifo_underflow*:6:6 spi_from_cpu_fifo_overflow*:5:5
    spi_from_cpu_fifo_underflow*:4:4 to_cpu_fifo_empty*:2:2 from_cpu_data_valid*:1:1
    to_cpu_fifo_full*:0:0
17 from_cpu_read_data*:7:0
18 spi_clear_to_cpu_fifo_overflow:7:7 spi_clear_to_cpu_fifo_underflow:6:6
    spi_clear_from_cpu_fifo_overflow:5:5 spi_clear_from_cpu_fifo_underflow:4:4
19 to_mem_write_data:7:0
20 spi_to_mem_fifo_overflow*:7:7 spi_to_mem_fifo_underflow*:6:6 spi_from_mem_fifo_overflow*:5:5
    spi_from_mem_fifo_underflow*:4:4 from_mem_data_valid*:2:2 to_mem_fifo_empty*:1:1
    to_mem_fifo_full*:0:0
21 from_mem_read_data*:7:0
22 spi_clear_to_mem_fifo_overflow:7:7 spi_clear_to_mem_fifo_underflow:6:6
    spi_clear_from_mem_fifo_overflow:5:5 spi_clear_from_mem_fifo_underflow:4:4
23 mem_readback_mode:1:1 mem_programming_mode:0:0
24 mem_first_addr_msb:7:0
25 mem_first_addr_lsb:7:0
26 boot_from_otp_spi:0:0
27 progmem_bist_en:1:1 intram_bist_en:0:0
28 progmem_bist_pass*:3:3 progmem_bist_done*:2:2 intram_bist_pass*:1:1 intram_bist_done*:0:0
29 spi_mode:0:0
127 cpu_reset:0:0
[xif]
0 debug_xif:7:0
1 sampler_preset_en:7:7 sampler_preset_val_msb:3:0
2 sampler_preset_val_lsb:7:0
3 dac_trim_a:5:3 dac_trim_b:2:0
4 preamp_trim:3:0
5 rx_fe_anatestreq:5:0
6 lna_anatestreq:1:0
7 dac_anatestreq:5:0
8 vref_trim:4:0
9 iref_trim:2:0
10 apc_temp_trim:2:0
"""


class RegmapError(Exception):
    """A field of a register does not exist, or cannot be read, written or hold a value."""

    def __init__(self, value: str) -> None:
        super().__init__(value)
        self.value = value


class RegisterField(NamedTuple):
    """Bits of a register."""

    space: str
    address: int
    high: int
    low: int
    readable: bool
    writable: bool


def _fields() -> Iterator[tuple[str, RegisterField]]:
    space, address = "", 0
    for word in _MAP.split():
        if word.startswith("["):
            space = word.strip("[]")
        elif word.isdigit():
            address = int(word)
        elif word.endswith("!"):
            yield word[:-1], RegisterField(space, address, 7, 0, readable=False, writable=True)
        else:
            name, high, low = word.split(":")
            read_only = name.endswith("*")
            yield (
                name.rstrip("*"),
                RegisterField(space, address, int(high), int(low), True, not read_only),
            )


FIELDS: Final = dict(_fields())


class X4:
    """The chip's registers: each field is an attribute, or a key."""

    def __init__(self, radar: Any, configfile_section_name: str = "registers") -> None:
        object.__setattr__(self, "_xep", radar)

    def __dir__(self) -> list[str]:
        return sorted(FIELDS)

    def __iter__(self) -> Iterator[str]:
        return iter(FIELDS)

    def __getattr__(self, name: str) -> int:
        field = FIELDS.get(name)
        if f"X4.{name}" in MISSING:
            not_implemented(f"X4.{name}")
        if field is None:
            raise AttributeError(f"the X4 has no register field {name}")
        if not field.readable:
            raise RegmapError(f"{name} starts an action and cannot be read")
        return self._register(field) >> field.low & _mask(field)

    def __setattr__(self, name: str, value: int) -> None:
        field = FIELDS.get(name)
        if field is None or not field.writable:
            raise RegmapError(
                f"the X4 has no register field {name}"
                if field is None
                else f"{name} can only be read"
            )
        if not 0 <= value <= _mask(field):
            raise RegmapError(f"{name} holds 0 ... {_mask(field)}, not {value}")
        others = 0
        if field.readable:
            others = self._register(field) & ~(_mask(field) << field.low)
        write = getattr(self._xep, f"x4driver_set_{field.space}_register")
        write(field.address, others | value << field.low)

    __getitem__ = __getattr__
    __setitem__ = __setattr__

    def _register(self, field: RegisterField) -> int:
        read = getattr(self._xep, f"x4driver_get_{field.space}_register")
        return int(read(field.address))


def _mask(field: RegisterField) -> int:
    return (1 << field.high - field.low + 1) - 1
